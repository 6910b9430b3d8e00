"""The descriptions of fields that several answers have."""

from typing import Annotated, Any

import msgspec

UNIT = "x-epoch"
"""The key of a time's unit in its schema."""


def doc(description: str, **bounds: Any) -> msgspec.Meta:
    return msgspec.Meta(description=description, **bounds)


Moment = Annotated[float, doc("seconds since the epoch", extra_json_schema={UNIT: "seconds"})]
"""A time in an answer."""

NanoMoment = Annotated[int, doc("nanoseconds since the epoch", extra_json_schema={UNIT: "nanoseconds"})]
"""The time of a message, for which the digits of a float are too few."""

RollbackDue = Annotated[Moment | None, doc("when it is rolled back automatically unless confirmed")]
"""The time until which a change must be confirmed."""

Name = Annotated[str, doc("its name")]
RevisionNumber = Annotated[int, doc("its number")]
Address = Annotated[str, doc("its address")]
VirtualAddress = Annotated[
    str, doc("virtual address in the tunnels; for a machine in clear text its own address")
]
Id = Annotated[str, doc("its unique id")]
RevisionNote = Annotated[str, doc("reason given by the person who loaded it")]
RosType = Annotated[str, doc("package/Type, as ROS has it")]
Who = Annotated[str, doc("name of the token, or the interface that was used")]
Resource = Annotated[str, doc("topic, service, parameter, node or call")]
Sentence = Annotated[str, doc("a sentence for a person")]
FilePath = Annotated[str, doc("path of the file")]
FromOne = Annotated[int, doc("from 1")]
