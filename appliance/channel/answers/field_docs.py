"""Short words for the fields of answers."""

from typing import Annotated, Any

import msgspec

UNIT = "x-epoch"
"""The key of a moment's unit in its schema."""


def doc(description: str, **bounds: Any) -> msgspec.Meta:
    return msgspec.Meta(description=description, **bounds)


Moment = Annotated[float, doc("seconds since the epoch", extra_json_schema={UNIT: "seconds"})]
"""A moment, as answers have it."""

NanoMoment = Annotated[int, doc("nanoseconds since the epoch", extra_json_schema={UNIT: "nanoseconds"})]
"""A moment of a message, for whom the digits of a float are too few."""

RollbackDue = Annotated[Moment | None, doc("when it is rolled back automatically unless confirmed")]
"""The end of the time in which a change is to be confirmed."""
