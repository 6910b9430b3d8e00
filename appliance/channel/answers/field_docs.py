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
