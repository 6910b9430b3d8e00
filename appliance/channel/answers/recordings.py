"""Recordings of the flight recorder: what was said before and after something happened, and where it is kept."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import told

TriggerKind = Literal["drop", "change", "verdict", "denial", "alarm", "fault", "order"]


class Trigger(msgspec.Struct, frozen=True):
    """Why messages were recorded."""

    time: Annotated[int, told("nanoseconds since the epoch")]
    what: TriggerKind
    record: Annotated[str, told("id of the audit record that says it")]
    text: str


class RecordedTopic(msgspec.Struct, frozen=True):
    """What a recording has of one topic of one type."""

    topic: str
    type: str
    md5sum: str
    messages: int
    bytes: int
    missed: Annotated[int, told("messages of that time for which the recorder's memory had no room")]


class Recording(msgspec.Struct, frozen=True):
    """One recording; it is also `recording.json` beside its bag."""

    id: str
    began: Annotated[int, told("nanoseconds since the epoch")]
    ended: Annotated[int, told("nanoseconds since the epoch")]
    triggers: list[Trigger]
    topics: list[RecordedTopic]
    policy: Annotated[int, told("revision of the policy in force at the end")]
    monitors: Annotated[int, told("revision of the specifications in force at the end")]
    size: Annotated[int, told("bytes of the bag")]
    sha256: Annotated[str, told("of the bag, hexadecimal")]
    complete: bool
    why_not: Annotated[str, told("what is missing, in words; empty when it is complete")]


class RecordingBegun(msgspec.Struct, frozen=True):
    """A recording that is being made."""

    id: str
    ends: Annotated[int, told("when it ends, or later if more happens: nanoseconds since the epoch")]


class Recordings(msgspec.Struct, frozen=True):
    """All recordings that are kept, the oldest first."""

    recordings: list[Recording]
