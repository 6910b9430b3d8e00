"""Define the requests of an evidence export, and their answer."""

from typing import Annotated

import msgspec

from appliance.channel.admin import WaitingRequest
from appliance.channel.rest_operation import rest


class Sealed(msgspec.Struct, frozen=True):
    """A signed checkpoint seals all records; `record` is the id of the request's record."""

    record: str = ""


@rest("viewer")
class LogSealed(WaitingRequest[Sealed], frozen=True, tag="audit seal"):
    """Seal all records now by a signed checkpoint."""


@rest("viewer")
class EvidenceExported(WaitingRequest[Sealed], frozen=True, tag="evidence exported"):
    """Record the export of the bundle whose manifest has this hash, and seal the record.

    The bundle has `records` records from `since` (inclusive) to `until` (exclusive), in nanoseconds since the epoch,
    and the recording with the id `recording`.
    """

    manifest: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
    since: int
    until: int
    records: int
    recording: str = ""


REQUESTS = (LogSealed, EvidenceExported)
