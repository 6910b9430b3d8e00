"""Requests of an evidence export, and their answer."""

from typing import Annotated

import msgspec

from appliance.channel.admin import WaitingRequest
from appliance.channel.rest_operation import rest


class Sealed(msgspec.Struct, frozen=True):
    """A signed checkpoint seals all that was recorded; `record` is the id of what was recorded for it, if anything."""

    record: str = ""


@rest("viewer")
class LogSealed(WaitingRequest[Sealed], frozen=True, tag="audit seal"):
    """Have all that was recorded sealed by a signed checkpoint, now."""


@rest("viewer")
class EvidenceExported(WaitingRequest[Sealed], frozen=True, tag="evidence exported"):
    """Record that a bundle was made whose manifest has this hash, and seal the record.

    The bundle has this number of `records`, from `since` until before `until` (nanoseconds since the epoch), and the
    `recording` of this id.
    """

    manifest: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
    since: int
    until: int
    records: int
    recording: str = ""
