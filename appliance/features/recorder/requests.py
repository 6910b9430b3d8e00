"""The requests of operators' tools about recordings."""

from typing import Annotated

import msgspec

from appliance.channel.admin import WaitingRequest
from appliance.channel.answers.field_docs import doc
from appliance.channel.rest_bodies import DATED, WHOLE
from appliance.channel.rest_operation import Body, parameter, rest
from appliance.features.recorder.recording_answers import Recording, RecordingBegun, Recordings

LONGEST_NOTE = 300
_NO_RECORDING = {404: "There is no such recording, or the flight recorder is off."}
RecordingId = Annotated[
    str,
    parameter(
        "id of the recording",
        name="recording_id",
        pattern="^[0-9a-f]{20}$" + WHOLE,
        examples=["18ea0bb9b11c1024196c"],
    ),
]


NanoMoment = Annotated[
    Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)] | None,
    doc("RFC 3339, or nanoseconds since the epoch", extra={DATED: True}),
]


@rest("viewer", "GET", "/v1/recordings", name="recordings", problems=_NO_RECORDING)
class RecordingsWanted(WaitingRequest[Recordings], frozen=True, tag="recordings"):
    """All stored recordings, oldest first."""


@rest("viewer", "GET", "/v1/recordings/{recording_id}", name="recording", problems=_NO_RECORDING)
class RecordingWanted(WaitingRequest[Recording], frozen=True, tag="recording"):
    """Why a recording was made, and its contents."""

    id: RecordingId


@rest(
    "operator", "POST", "/v1/recordings", name="record_now", status=201,
    body=Body(
        "NewRecording", "The wanted recording: seconds before and after now (by default, as configured), and why."
    ),
    good="The recording is being made.", problems=_NO_RECORDING,
)  # fmt: skip
class RecordNow(WaitingRequest[RecordingBegun], frozen=True, tag="record now"):
    """Record the messages of the seconds before and after now."""

    before: Annotated[Annotated[float, msgspec.Meta(ge=0, le=3600)] | None, doc("seconds")] = None
    after: Annotated[Annotated[float, msgspec.Meta(gt=0, le=3600)] | None, doc("seconds")] = None
    note: Annotated[str, doc("reason given by the person who loaded it", max_length=LONGEST_NOTE)] = ""


@rest("investigator", "GET", "/v1/recordings/{recording_id}/bag")
class RecordingFetch(WaitingRequest[Recording], frozen=True, tag="recording fetch"):
    """Record in the audit log who fetches the messages of a recording."""

    id: RecordingId


@rest("investigator", "GET", "/v1/recordings/{recording_id}/messages", ("topics",))
class RecordingRead(WaitingRequest[Recording], frozen=True, tag="recording read"):
    """Record in the audit log who reads messages of a recording, of these topics (none: of all)."""

    id: RecordingId
    topics: Annotated[list[str], parameter(name="topic")] = msgspec.field(default_factory=list)


@rest(
    "investigator", "POST", "/v1/recordings/memory", name="recording_of_memory", problems=_NO_RECORDING,
    body=Body("MemorySpan", "A period from `since` (by default, the first data) to `until` (by default, now)."),
)  # fmt: skip
class RecordingOfMemory(WaitingRequest[Recording], frozen=True, tag="recording memory"):
    """Make a recording of the data in memory, which can be fetched for ten minutes, or until four later requests."""

    since: NanoMoment = None
    until: NanoMoment = None


@rest("admin", "DELETE", "/v1/recordings/{recording_id}", name="remove_recording", problems=_NO_RECORDING)
class RecordingRemove(WaitingRequest[Recording], frozen=True, tag="recording remove"):
    """Remove a recording. The audit log records who removed it. For admins."""

    id: RecordingId


REQUESTS = (
    RecordingsWanted, RecordingWanted, RecordNow, RecordingFetch, RecordingRead, RecordingOfMemory, RecordingRemove,
)  # fmt: skip
