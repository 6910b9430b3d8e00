"""The recorder's links: the memory that the supervisor gives to relays and recorder, and control <-> the recorder."""

from typing import ClassVar

import msgspec

from appliance.channel.answers.recording_answers import Recording, Trigger
from appliance.channel.messages.message import Message


class RingGiven(Message):
    """The supervisor gives relay `index`, and the recorder, the memory in which that relay leaves what it receives.

    It was made at `since` (nanoseconds since the epoch). The relay keeps `seconds` of the topics of which a glob of
    `topics` fits the name, but none of which one of `never` fits the name or the type. `sums` has the md5sums of the
    types that a glob of `never` fits, as far as they are known: a topic that claims such a type must have its sum.
    """

    descriptors: ClassVar[int] = 1
    index: int
    since: int
    seconds: float
    topics: list[str]
    never: list[str]
    sums: dict[str, str] = msgspec.field(default_factory=dict)


class RecordingsAsked(Message):
    """Control asks which recordings are kept, and to be told again of those that it has not noted."""


class RecordingsStated(Message):
    """All recordings that are kept, the oldest first."""

    recordings: list[Recording]


class RevisionsWanted(Message):
    """The recorder asks what is in force."""


class RevisionsStated(Message):
    """The revisions of policy and specifications in force."""

    policy: int
    monitors: int


class RecordingClosed(Message):
    """A recording is whole; told again until control has noted it."""

    recording: Recording


class RecordingNoted(Message):
    """Control has made an audit record of a recording, or of its removal."""

    id: str


class RecordingWanted(Message):
    """Control asks for a recording from `before` seconds before now (`trigger`) to `after` seconds after."""

    number: int
    trigger: Trigger
    before: float
    after: float


class RecordingBegun(Message):
    """What was asked for as `number` is in recording `id`, from `began` to `ends` (ns) or later."""

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
    """A recording is gone: for `who` (then `number` is that of the order), or because of `reason`.

    Told again until control has noted it.
    """

    number: int
    recording: Recording
    who: str
    reason: str


class MemoryWanted(Message):
    """Control asks for what is in memory of the time from `since` to `until` (ns), to be read and not to be kept."""

    number: int
    trigger: Trigger
    since: int
    until: int


class MemoryLent(Message):
    """What was asked for as `number` can be read as `recording`, which goes by itself or for later ones."""

    number: int
    recording: Recording


class RecordingRefused(Message):
    """What was asked for as `number` is not done; `unknown`: there is no such recording."""

    number: int
    reason: str
    unknown: bool = False


class RecordingMissed(Message):
    """Something that is a trigger made no recording, and why; told once in a while only.

    `planned` is the recording that the trigger's record promised, if it did.
    """

    trigger: Trigger
    reason: str
    planned: str = ""


RecorderLink = (
    RecordingsAsked | RecordingsStated | RevisionsWanted | RevisionsStated | RecordingClosed | RecordingNoted
    | RecordingWanted | RecordingBegun | RecordingRemovalWanted | RecordingRemoved | RecordingRefused | RecordingMissed
    | MemoryWanted | MemoryLent
)  # fmt: skip
