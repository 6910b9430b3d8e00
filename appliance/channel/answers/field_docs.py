"""Short words for the fields of answers."""

from typing import Annotated, Any

import msgspec


def told(description: str, **bounds: Any) -> msgspec.Meta:
    """What the contract says of a field, and its bounds."""
    return msgspec.Meta(description=description, **bounds)


Moment = Annotated[float, told("seconds since the epoch")]
"""A moment, as answers have it."""
