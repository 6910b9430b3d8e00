"""Answers about recordings of the flight recorder."""

from typing import Annotated, Any, Literal

import msgspec

from appliance.base.actors import APPLIANCE
from appliance.channel.answers.field_docs import Address, Id, Name, NanoMoment, RosType, doc

OPERATORS = "operators"
"""The payer of recordings that operators order. Other recordings are charged as control's `charged_to` decides."""

TriggerKind = Literal["drop", "change", "verdict", "stop", "denial", "alarm", "fault", "service", "order"]
EventKind = Literal["drop", "change", "verdict", "denial", "alarm", "fault", "notice"]


class Trigger(msgspec.Struct, frozen=True):
    """Why messages were recorded."""

    time: NanoMoment
    what: Annotated[TriggerKind, doc("its kind")]
    record: Annotated[str, doc("id of the trigger's audit record")]
    text: Annotated[str, doc("what happened, in words")]
    charged_to: Annotated[
        str, doc("who caused it: robot, operators, appliance, unknown hosts, a host or network")
    ] = APPLIANCE
    monitor: Annotated[str, doc("the monitor that acted; empty for other triggers")] = ""
    resource: Annotated[str, doc("topic, service or call of the audit record")] = ""
    host: Annotated[str, doc("address of the peer in the audit record")] = ""
    caller_id: Annotated[str, doc("the name that this peer gave: a claim")] = ""
    equal: Annotated[
        str, doc("the same in triggers whose audit records are equal, or empty if equal to none")
    ] = ""


class RecordedTopic(msgspec.Struct):
    """The part of a recording with one topic of one type."""

    topic: Name
    type: RosType
    md5sum: Annotated[str, doc("MD5 sum of the type, as ROS computes it")]
    messages: Annotated[int, doc("number of its messages in the recording")]
    bytes: Annotated[int, doc("bytes of its messages in the recording")]
    missed: Annotated[int, doc("messages of that time that did not fit in the recorder's memory")]


class LeftOutTopic(msgspec.Struct, frozen=True):
    """A topic that had messages during the recording and was left out (`recorder.never`); one for each publisher."""

    topic: Name
    type: Annotated[str, doc("type that the publisher declared")]
    host: Address
    why: Annotated[str, doc("the setting that excluded it")]


class Recording(msgspec.Struct, frozen=True):
    """One recording; also stored as `recording.json` beside its bag."""

    id: Id
    began: NanoMoment
    ended: NanoMoment
    triggers: Annotated[list[Trigger], doc("triggers of the recording, in order")]
    topics: Annotated[list[RecordedTopic], doc("topics with the number of recorded messages")]
    policy: Annotated[int, doc("revision of the policy in force at the end")]
    monitors: Annotated[int, doc("revision of the specifications in force at the end")]
    size: Annotated[int, doc("bytes of the bag")]
    sha256: Annotated[str, doc("SHA-256 of the bag, in hexadecimal")]
    complete: Annotated[bool, doc("whether it is complete")]
    why_not: Annotated[str, doc("what is missing, in words; empty if it is complete")]
    left_out: Annotated[
        list[LeftOutTopic], doc("the first topics that recorder.never excluded, and why")
    ] = []
    charged_to: Annotated[str, doc("whose quotas of recordings per hour and of disk space it uses")] = (
        OPERATORS
    )


class OpenRecording(msgspec.Struct, frozen=True):
    """A recording that is still being made."""

    id: Id
    began: NanoMoment
    ends: Annotated[NanoMoment, doc("when it ends, or later after further triggers")]
    trigger: Annotated[Trigger, doc("the first trigger")]


class RecordingBegun(msgspec.Struct, frozen=True):
    """A recording that is being made."""

    id: Id
    ends: Annotated[
        NanoMoment, doc("when it ends, or later after further triggers: nanoseconds since the epoch")
    ]


class Recordings(msgspec.Struct, frozen=True):
    """All stored recordings, oldest first, and the topics that are recorded."""

    recordings: Annotated[list[Recording], doc("stored recordings")]
    topics: Annotated[list[str], doc("names of topics that are recorded; `*` matches anything")] = []
    never: Annotated[list[str], doc("names and types that are never recorded")] = []
    before: Annotated[float, doc("seconds of messages that the memory keeps")] = 0.0
    in_progress: Annotated[
        list[OpenRecording], doc("recordings that are still being made: listed above when they have ended")
    ] = []
    publish_as: Annotated[str, doc("the node name under which monitors publish")] = "/rosrv"


class Sender(msgspec.Struct, frozen=True):
    """A node that published, and its machine; the host is empty for messages that monitors published."""

    node: Name
    host: Address


class RecordedFlow(msgspec.Struct, frozen=True):
    """The traffic of a topic: the number of messages in each column of the time line."""

    topic: Name
    type: RosType
    senders: Annotated[list[Sender], doc("the publisher")]
    counts: Annotated[list[int], doc("messages in each column, in their order")]


class EventMarks(msgspec.Struct, frozen=True):
    """The number of events of one kind in each column of the time line, including events that are not listed.

    Events that a record only counts are spread evenly over the time between the first and the last.
    """

    kind: Annotated[EventKind, doc("kind of the event")]
    counts: Annotated[list[int], doc("events in each column, in their order")]


class RecordedEvent(msgspec.Struct, frozen=True, kw_only=True):
    """An event from an audit record of the recorded time; `notice` is a notable event of no other kind."""

    time: NanoMoment
    kind: Annotated[EventKind, doc("kind of the event")]
    record: Annotated[str, doc("id of the audit record")]
    event: Annotated[str, doc("its stable name")]
    severity: Annotated[str, doc("severity of the audit record")]
    decision: Annotated[str | None, doc("allow, deny, would deny or ask, or null if nothing was decided")]
    host: Annotated[str | None, doc("the host that the record is about")]
    caller_id: Annotated[str | None, doc("the name the node gave: a claim")]
    resource: Annotated[str | None, doc("topic, service, call or monitor")]
    reason: Annotated[str, doc("the reason, in words")]
    times: Annotated[int, doc("how often it happened: a record may count repetitions")] = 1


class Timeline(msgspec.Struct, frozen=True):
    """A recording, or a part of it, in columns of equal time: traffic and events."""

    id: Id
    since: Annotated[NanoMoment, doc("where the first column begins: nanoseconds since the epoch")]
    until: Annotated[NanoMoment, doc("the last moment of the last column: nanoseconds since the epoch")]
    topics: Annotated[
        list[RecordedFlow],
        doc("sorted by name, including topics of the recording without a message in this part"),
    ]
    more_topics: Annotated[int, doc("number of topics with fewer messages that are omitted")]
    marks: Annotated[list[EventMarks], doc("marks of each kind of event that occurred")]
    events: Annotated[list[RecordedEvent], doc("the first events, or those around `record`, in order")]
    more_events: Annotated[int, doc("number of further events of this time, which a shorter part would list")]


class RecordedMessage(msgspec.Struct, frozen=True):
    """A recorded message as its publisher sent it, before monitors processed it."""

    time: Annotated[NanoMoment, doc("when the relay received it: nanoseconds since the epoch")]
    place: Annotated[str, doc("position in the recording, which `at` takes")]
    topic: Name
    type: RosType
    sender: Annotated[Sender, doc("the publisher")]
    size: Annotated[int, doc("bytes, without the length prefix")]
    fields: Annotated[dict[str, Any], doc("fields as in a message of /v1/messages")]
    why: Annotated[str, doc("why only the first bytes are shown instead of the fields; else empty")]
    carried: Annotated[
        bool,
        doc("false if the relay dropped it before monitors: by a limit, a rank, or as a repeated command"),
    ] = True


class RecordedMessages(msgspec.Struct, frozen=True):
    """Messages of a recording around a time, in order."""

    id: Id
    messages: Annotated[list[RecordedMessage], doc("messages relayed since counting began")]
    chosen: Annotated[
        int, doc("index of the message that the record is about, or the last one at or before the time; or 0")
    ]
