"""The messages between control and the recorder, and the terms of the memory that relays and recorder share."""

import msgspec

from appliance.channel.messages.message import Message
from appliance.features.recorder.recording_answers import OpenRecording, Recording, Trigger

CLOCK_STEP = 100_000_000
"""The nanoseconds by which the machine's clock must be set before the recorder notices it."""


class RingTerms(msgspec.Struct, frozen=True):
    """The terms of the memory of relay `index`, made at `since` (nanoseconds since the epoch)."""

    index: int
    since: int
    seconds: float
    topics: list[str]
    never: list[str]
    """Globs for topics and types."""
    sums: dict[str, str] = msgspec.field(default_factory=dict)
    """The known md5sums of excluded types. A topic with another md5sum is recorded."""
    ahead: int = 0
    """How far the machine's clock was ahead of the monotonic one at `since`, in nanoseconds."""


class RecordingsAsked(Message, frozen=True):
    """Control asks for all recordings, and for the reports that it has not noted."""


class RecordingsStated(Message, frozen=True):
    """All kept recordings, oldest first, and those in progress."""

    recordings: list[Recording]
    in_progress: list[OpenRecording] = msgspec.field(default_factory=list)


class RecordingOpened(Message, frozen=True):
    """The recorder began a recording."""

    recording: OpenRecording


class RevisionsWanted(Message, frozen=True):
    """The recorder asks for the revisions in force."""


class RevisionsStated(Message, frozen=True):
    """The revisions of policy and specifications in force."""

    policy: int
    monitors: int


class RecordingClosed(Message, frozen=True):
    """A recording is complete; this report is repeated until control has noted it."""

    recording: Recording


class RecordingNoted(Message, frozen=True):
    """Control has recorded a recording, or its removal."""

    id: str


class RecordingRequested(Message, frozen=True):
    """Control asks for a recording from `before` to `after`: seconds before and after a trigger."""

    number: int
    trigger: Trigger
    before: float
    after: float


class RecordingStarted(Message, frozen=True):
    """The recording `id` of request `number` lasts from `began` to `ends` (ns) or later."""

    number: int
    id: str
    ends: int
    began: int = 0


class RecordingRemovalWanted(Message, frozen=True):
    """Control asks for a removal by `who`."""

    number: int
    id: str
    who: str


class RecordingRemoved(Message, frozen=True):
    """A recording was removed; this report is repeated until control has noted it."""

    number: int
    recording: Recording
    who: str
    reason: str


class MemoryWanted(Message, frozen=True):
    """Control asks for the memory from `since` to `until` (ns), as a temporary recording."""

    number: int
    trigger: Trigger
    since: int
    until: int


class MemoryLent(Message, frozen=True):
    """A temporary `recording` can be read, until it expires or later ones replace it."""

    number: int
    recording: Recording


class RecordingRefused(Message, frozen=True):
    """The recorder refuses a request. `unknown` is true if there is no such recording or period."""

    number: int
    reason: str
    unknown: bool = False


class RecordingMissed(Message, frozen=True):
    """A trigger made no recording; only some are reported."""

    trigger: Trigger
    reason: str
    planned: str = ""
    """The recording that the trigger's audit record promised."""
    instead: OpenRecording | None = None
    """The recording of the same owner that the trigger prolonged."""


RecorderLink = (
    RecordingsAsked | RecordingsStated | RevisionsWanted | RevisionsStated | RecordingOpened | RecordingClosed
    | RecordingNoted | RecordingRequested | RecordingStarted | RecordingRemovalWanted | RecordingRemoved
    | RecordingRefused | RecordingMissed | MemoryWanted | MemoryLent
)  # fmt: skip
