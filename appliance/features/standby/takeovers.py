"""Define the records of takeovers between two appliances.

A record names the other chain's last replicated checkpoint, and the takeover before it. So a removed record is
noticed, although epochs may have gaps.
"""

from typing import Annotated

import msgspec

from appliance.audit.proof.copies import SignedCheckpoint

TOOK_OVER = "took over"
_Epoch = Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)]
_Name = Annotated[str, msgspec.Meta(pattern=r"^[a-z][a-z0-9-]{0,31}\Z")]


class EpochOf(msgspec.Struct, frozen=True):
    """An epoch, and the appliance that took over in it."""

    epoch: _Epoch
    appliance: _Name


class TookOver(msgspec.Struct, frozen=True, kw_only=True):
    """The detail of a `took over` record; `checkpoint` is the last replicated one of the `other` appliance's log."""

    epoch: _Epoch
    appliance: _Name
    other: _Name
    checkpoint: SignedCheckpoint | None
    previous: EpochOf | None


class HandedOver(msgspec.Struct, frozen=True, kw_only=True):
    """The detail of a `handed over` record: `appliance` answered for the last time in this epoch."""

    epoch: _Epoch
    appliance: _Name
    to: _Name
