"""The recorder's links: the memory that the supervisor gives to relays and recorder, and control <-> the recorder."""

from typing import ClassVar

import msgspec

from appliance.channel.answers.recording_answers import Recording, Trigger
from appliance.channel.messages.message import Message


class RingGiven(Message):
    """The supervisor gives relay `index`, and the recorder, the memory in which that relay leaves what it receives.

    It was made at `since` (nanoseconds since the epoch). The relay keeps `seconds` of the topics whose name matches a
    glob of `topics`, except those whose name or type matches one of `never`. `sums` has the known md5sums of types that
    match a glob of `never`: a topic that claims such a type must have its sum.
    """

    descriptors: ClassVar[int] = 1
    index: int
    since: int
    seconds: float
    topics: list[str]
    never: list[str]
    sums: dict[str, str] = msgspec.field(default_factory=dict)


class RecordingsAsked(Message):
    """Control asks for the list of recordings, and for another report of those that it has not noted."""


class RecordingsStated(Message):
    """All recordings that are kept, the oldest first."""

    recordings: list[Recording]


class RevisionsWanted(Message):
    """The recorder asks for the revisions in force."""


class RevisionsStated(Message):
    """The revisions of policy and specifications in force."""

    policy: int
    monitors: int


class RecordingClosed(Message):
    """A recording is complete; repeated until control has noted it."""

    recording: Recording


class RecordingNoted(Message):
    """Control has made an audit record of a recording, or of its removal."""

    id: str


class RecordingRequested(Message):
    """Control asks for a recording from `before` seconds before now (`trigger`) to `after` seconds after."""

    number: int
    trigger: Trigger
    before: float
    after: float


class RecordingStarted(Message):
    """The recording of request `number` is `id`, from `began` to `ends` (ns) or later."""

    number: int
    id: str
    ends: int
    began: int = 0


class RecordingRemovalWanted(Message):
    """Control asks to remove a recording for `who`."""

    number: int
    id: str
    who: str


class RecordingRemoved(Message):
    """A recording was removed: for `who` (then `number` is that of the order), or because of `reason`.

    Repeated until control has noted it.
    """

    number: int
    recording: Recording
    who: str
    reason: str


class MemoryWanted(Message):
    """Control asks for the data in memory from `since` to `until` (ns), to be read but not kept."""

    number: int
    trigger: Trigger
    since: int
    until: int


class MemoryLent(Message):
    """The data of request `number` can be read as `recording`, which expires or makes room for later ones."""

    number: int
    recording: Recording


class RecordingRefused(Message):
    """Request `number` was refused; `unknown`: there is no such recording."""

    number: int
    reason: str
    unknown: bool = False


class RecordingMissed(Message):
    """A trigger made no recording, with the reason; sent only now and then.

    `planned` is the recording that the trigger's record promised, if it did.
    """

    trigger: Trigger
    reason: str
    planned: str = ""


RecorderLink = (
    RecordingsAsked | RecordingsStated | RevisionsWanted | RevisionsStated | RecordingClosed | RecordingNoted
    | RecordingRequested | RecordingStarted | RecordingRemovalWanted | RecordingRemoved | RecordingRefused
    | RecordingMissed | MemoryWanted | MemoryLent
)  # fmt: skip
