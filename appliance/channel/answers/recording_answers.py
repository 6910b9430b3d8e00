"""Recordings of the flight recorder: what was said before and after something happened, and where it is kept."""

from typing import Annotated, Any, Literal

import msgspec

from appliance.channel.answers.field_docs import NanoMoment, told

ROBOT, OPERATORS, APPLIANCE, UNKNOWN = "robot", "operators", "appliance", "unknown hosts"
"""Recordings are charged to these, or to a host or network as the policy names it."""

TriggerKind = Literal["drop", "change", "verdict", "denial", "alarm", "fault", "service", "order"]
EventKind = Literal["drop", "change", "verdict", "denial", "alarm", "fault", "notice"]


class Trigger(msgspec.Struct, frozen=True):
    """Why messages were recorded."""

    time: NanoMoment
    what: TriggerKind
    record: Annotated[str, told("id of the audit record that says it")]
    text: str
    charged_to: Annotated[
        str, told("whose act it was: robot, operators, appliance, unknown hosts, a host or network")
    ] = APPLIANCE


class RecordedTopic(msgspec.Struct, frozen=True):
    """The part of a recording with one topic of one type."""

    topic: str
    type: str
    md5sum: str
    messages: int
    bytes: int
    missed: Annotated[int, told("messages of that time for which the recorder's memory had no room")]


class LeftOutTopic(msgspec.Struct, frozen=True):
    """A topic of one publisher that carried messages in that time and is not in the recording (`recorder.never`)."""

    topic: str
    type: Annotated[str, told("as the publisher says")]
    host: str
    why: Annotated[str, told("by whose word it was left out")]


class Recording(msgspec.Struct, frozen=True):
    """One recording; it is also `recording.json` beside its bag."""

    id: str
    began: NanoMoment
    ended: NanoMoment
    triggers: list[Trigger]
    topics: list[RecordedTopic]
    policy: Annotated[int, told("revision of the policy in force at the end")]
    monitors: Annotated[int, told("revision of the specifications in force at the end")]
    size: Annotated[int, told("bytes of the bag")]
    sha256: Annotated[str, told("of the bag, hexadecimal")]
    complete: bool
    why_not: Annotated[str, told("what is missing, in words; empty when it is complete")]
    left_out: Annotated[
        list[LeftOutTopic], told("the first topics that recorder.never left out, and why")
    ] = []
    charged_to: Annotated[str, told("whose share of the hour and of the disk it takes")] = OPERATORS


class RecordingBegun(msgspec.Struct, frozen=True):
    """A recording that is being made."""

    id: str
    ends: Annotated[NanoMoment, told("when it ends, or later if more happens: nanoseconds since the epoch")]


class Recordings(msgspec.Struct, frozen=True):
    """All recordings that are kept, the oldest first, and what is recorded."""

    recordings: list[Recording]
    topics: Annotated[list[str], told("names of topics that are recorded; `*` is anything")] = []
    never: Annotated[list[str], told("names and types that are never recorded")] = []
    before: Annotated[float, told("seconds that the memory keeps")] = 0.0


class Sender(msgspec.Struct, frozen=True):
    """A node that published, and its machine; of what monitors published the host is empty."""

    node: str
    host: str


class RecordedFlow(msgspec.Struct, frozen=True):
    """The traffic of a topic: the number of messages in each column of the time line."""

    topic: str
    type: str
    senders: Annotated[list[Sender], told("who published it")]
    counts: Annotated[list[int], told("messages in each column, in their order")]


class EventMarks(msgspec.Struct, frozen=True):
    """The events of a kind: their number in each column of the time line, including those that are not listed."""

    kind: EventKind
    counts: Annotated[list[int], told("events in each column, in their order")]


class RecordedEvent(msgspec.Struct, frozen=True, kw_only=True):
    """An event from an audit record of that time; `notice` is an event that is not a trigger, such as a change by
    people.
    """

    time: NanoMoment
    kind: EventKind
    record: Annotated[str, told("id of the audit record")]
    event: str
    severity: str
    decision: Annotated[str | None, told("allow, deny or would deny; null: nothing was decided")]
    host: Annotated[str | None, told("of whom it is about")]
    caller_id: str | None
    resource: Annotated[str | None, told("topic, service, call or monitor")]
    reason: Annotated[str, told("why, in words")]


class Timeline(msgspec.Struct, frozen=True):
    """A recording, or a part of it, in columns of equal time: what flowed, and what happened."""

    id: str
    since: Annotated[NanoMoment, told("where the first column begins: nanoseconds since the epoch")]
    until: Annotated[NanoMoment, told("the last moment of the last column: nanoseconds since the epoch")]
    topics: Annotated[
        list[RecordedFlow], told("by their names, those of the recording without a message here too")
    ]
    more_topics: Annotated[int, told("topics with fewer messages that are left out, in number")]
    marks: Annotated[list[EventMarks], told("of each kind that happened")]
    events: Annotated[list[RecordedEvent], told("the first of them, in their order")]
    more_events: Annotated[
        int, told("further events of this time, which a shorter part would list, in number")
    ]


class RecordedMessage(msgspec.Struct, frozen=True):
    """A message of a recording as its publisher sent it, before the monitors."""

    time: Annotated[NanoMoment, told("when the relay received it: nanoseconds since the epoch")]
    place: Annotated[str, told("where it is in the recording; `at` takes it")]
    topic: str
    type: str
    sender: Annotated[Sender, told("who published it")]
    size: Annotated[int, told("bytes, without those of its length")]
    fields: Annotated[dict[str, Any], told("as those of a message of /v1/messages")]
    why: Annotated[str, told("why there are no fields but the first bytes; else empty")]


class RecordedMessages(msgspec.Struct, frozen=True):
    """Messages of a recording around a moment, in their order."""

    id: str
    messages: list[RecordedMessage]
    chosen: Annotated[
        int, told("position of the first one at that moment or after it; their number: there is none")
    ]
