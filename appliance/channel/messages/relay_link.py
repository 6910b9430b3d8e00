"""The link control <-> relay. Control states what is wanted; the relay reports what it sees.

`key` is the key of an incarnation. Each link has one file, so that related messages are changed together.
"""

from typing import Any, ClassVar, Literal

import msgspec

from appliance.channel.messages.message import Message


class StateBegan(Message):
    """Control restates everything: facts that it does not restate before `StateEnded` are withdrawn."""

    epoch: int


class StateEnded(Message):
    """End of the restatement that began with the same epoch."""

    epoch: int


class OrdersAsked(Message):
    """Control asks for `OrdersCarriedOut` when all its earlier orders are carried out."""


class OrdersCarriedOut(Message):
    """The relay's answer to `OrdersAsked`; several are answered in order."""


class NodePlaced(Message):
    """An incarnation, and the listening socket that replaces its TCPROS port.

    `host` is the address at which the node is called, `name` the node's name (its `callerid`). `monitors`: it is the
    appliance's own publisher, whose port sends the messages that monitors publish.
    """

    descriptors: ClassVar[int] = 1
    key: str
    name: str
    host: str
    monitors: bool = False


class NodeWithdrawn(Message):
    """An incarnation is gone: its port is closed, its connections are cut."""

    key: str


class FlowLimit(msgspec.Struct, frozen=True, array_like=True):
    """The traffic that may pass in a second: messages, bytes; 0 is unlimited."""

    messages: float = 0.0
    bytes: float = 0.0


UNLIMITED = FlowLimit()


class PublicationPlaced(Message):
    """The incarnation publishes this topic (type as registered, `*` when unknown).

    `limit` is for all publications of the topic on this host, `together` for all of the topic, which hosts (by
    `counted_as`) share equally. A second statement changes the limits. `named`: the policy names the node's host, not
    only all hosts (`*`).
    """

    key: str
    topic: str
    type: str
    limit: FlowLimit = UNLIMITED
    together: FlowLimit = UNLIMITED
    counted_as: str = ""
    named: bool = True


class PublicationWithdrawn(Message):
    """The incarnation no longer publishes this topic: its connections are cut."""

    key: str
    topic: str


class ServicePlaced(Message):
    """The incarnation offers this service at `host:port` (TCPROS)."""

    key: str
    service: str
    host: str
    port: int


class ServiceWithdrawn(Message):
    """The incarnation no longer offers this service: its connections are cut."""

    key: str
    service: str


class GrantInstalled(Message):
    """This subscriber (host, caller_id) may subscribe to this topic of that incarnation, up to a limit.

    A second statement changes the limit. `named`: the policy names the host, not only all hosts (`*`).
    """

    key: str
    topic: str
    host: str
    caller_id: str
    limit: FlowLimit = UNLIMITED
    named: bool = True


class GrantRevoked(Message):
    """The grant is gone; a connection that uses it is cut."""

    key: str
    topic: str
    host: str
    caller_id: str


class ClientGranted(Message):
    """This client (host, caller_id) may call this service of that incarnation.

    `named`: the policy names the host, not only all hosts (`*`).
    """

    key: str
    service: str
    host: str
    caller_id: str
    named: bool = True


class ClientRevoked(Message):
    """The client may no longer call the service; connections that use it are cut."""

    key: str
    service: str
    host: str
    caller_id: str


class UpstreamWanted(Message):
    """The relay needs the publisher's TCPROS address for a topic: control calls `requestTopic` there."""

    key: str
    topic: str


class UpstreamFound(Message):
    """Answer to `UpstreamWanted`: connect here."""

    key: str
    topic: str
    host: str
    port: int


class UpstreamRefused(Message):
    """Answer to `UpstreamWanted`: the publisher cannot be asked or refused; the relay asks again later."""

    key: str
    topic: str
    reason: str


Violation = Literal["", "limit exceeded", "malformed", "connection refused"]


class UpstreamLost(Message):
    """A connection to a publisher broke or could not be made: control checks the node at once.

    `violation` is the event to record if the relay cut it because of the publisher's data; otherwise empty.
    """

    key: str
    topic: str
    reason: str
    violation: Violation = ""


class LatchRefused(Message):
    """A latched message of a publisher is passed on and not kept: its host has no memory left for latched messages."""

    key: str
    topic: str
    size: int


NO_GRANT = "no grant for"
"""The beginning of the reason of a `ConnectionRefused` without a grant, and of no other."""


class ConnectionOpened(Message):
    """A subscriber (`topic` set) or a client (`service` set) is connected through the relay."""

    number: int
    key: str
    resource: str
    kind: str  # "topic" or "service"
    host: str
    caller_id: str


class ConnectionClosed(Message):
    """A connection that was reported open is closed; `reason` is empty for an orderly end."""

    number: int
    reason: str


class ConnectionRefused(Message):
    """A connection to a relay port was refused; `resource` is the topic or service that the header asked for.

    `kind` is "topic" or "service"; both are empty for a header that names neither.
    """

    key: str
    kind: str
    resource: str
    host: str
    caller_id: str
    reason: str
    count: int  # identical refusals are counted together


DELAY_BOUNDS = (0.00005, 0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.1)
"""Bounds (seconds) of the delays that `TopicTraffic` counts."""


class TopicTraffic(msgspec.Struct, frozen=True, array_like=True):
    """The traffic of one relayed topic since the last report.

    `delays` counts messages by the time from their receipt to the write to the subscribers' sockets: up to each of
    `DELAY_BOUNDS`, and beyond; empty if none was delivered. `delay_seconds` is their sum. `md5sum` is from the
    publisher's header; empty while it is not known, and for services.
    """

    key: str
    resource: str
    messages: int
    bytes: int
    dropped: int  # at slow subscribers
    subscribers: int
    delays: list[int] = msgspec.field(default_factory=list)
    delay_seconds: float = 0.0
    md5sum: str = ""


class LimitedRow(msgspec.Struct, frozen=True, array_like=True):
    """Messages of a publication that a limit dropped since the last report.

    `part` is the scope of the limit. `host` and `caller_id` are the publisher's, or for a subscriber's limit its own.
    """

    key: str
    topic: str
    part: Literal["publisher", "subscriber", "topic"]
    host: str
    caller_id: str
    messages: int
    bytes: int


class MessagesLimited(Message):
    """The messages that limits of the policy dropped; at most once a second."""

    rows: list[LimitedRow]


class TrafficReported(Message):
    """Counters of all relayed topics and services that changed; once a second at most.

    `over` is the seconds that they cover. `unrecorded` counts connections that came and went without a control and are
    not reported one by one. `memory` has the bytes that all hosts hold now, by kind.
    """

    rows: list[TopicTraffic]
    over: float = 1.0
    unrecorded: int = 0
    memory: dict[str, int] = msgspec.field(default_factory=dict)


class SpecificationsStated(Message):
    """Control states the specifications in force: before anything is placed, and at every change.

    `part` is this relay's part of the compiled specifications (`rosmop/fast/serialization.py`; empty: it has none).
    `enabled` has for each monitor of this relay whether its events happen. With `restarted`, a relay without
    specifications replaces one that died, so monitors with the modifier `hold` block their topics. So do the monitors
    in `moved`, which come from another relay and begin here. `statement` numbers the statements and is repeated in the
    answer, because the same revision may be stated again. With `ahead`, later statements are carried out once this one
    is in force (or refused), so that nothing is placed before its monitors. The monitors in `shadows` are in shadow
    mode: they get copies of messages. `slices` is the largest number of slices of a parametric specification.
    """

    revision: int
    part: bytes
    enabled: dict[str, bool]
    restarted: bool
    on_fault: Literal["drop", "pass"] = "drop"
    moved: tuple[str, ...] = ()
    statement: int = 0
    ahead: bool = False
    shadows: tuple[str, ...] = ()
    slices: int = 100_000


class MonitorSwitched(Message):
    """From now on the events of this monitor happen, or do not."""

    name: str
    enabled: bool


class MonitorResumed(Message):
    """A monitor that holds its topics lets them go on."""

    name: str


class SpecificationsTaken(Message):
    """The relay has these specifications in force. `began` are the monitors that started in their initial state, `held`
    those that hold their topics, `because` the reasons of those that do so because their state is lost.
    """

    revision: int
    began: list[str]
    held: list[str]
    statement: int = 0
    because: dict[str, str] = msgspec.field(default_factory=dict)


class SpecificationsRefused(Message):
    """The relay could not take the specifications: its present ones stay; without any, everything is blocked."""

    revision: int
    findings: list[str]
    statement: int = 0


class OwnHeaderStated(Message):
    """The connection header, without names, of a topic on which control itself publishes (`OwnPublished`)."""

    topic: str
    type: str
    md5sum: str
    definition: str


class OwnPublished(Message):
    """Control publishes a message as the appliance's own publisher; `data` is without its length."""

    topic: str
    data: bytes


class OwnServiceCalled(Message):
    """A client called the service that the appliance itself offers; it waits for `OwnServiceAnswered`."""

    number: int
    service: str
    host: str
    caller_id: str


class OwnServiceAnswered(Message):
    """The result of a call of the appliance's own service, in words."""

    number: int
    success: bool
    text: str


class PublicationRefused(Message):
    """A publisher (or service) is not carried, because its definition differs from that of the specifications."""

    key: str
    resource: str
    reason: str


class MonitorEvent(msgspec.Struct, frozen=True, array_like=True):
    """An action of a monitor: the first of its kind and second in full, the others as a count.

    `kind` is verdict, drop, change, fault, log or publish. With the prefix "shadow " it is what a monitor in shadow
    mode would have done ("shadow missed": a message that it did not get); `time` is nanoseconds since the epoch;
    `before` and `after` are the first bytes of the message (`size` is its whole length). `count` is 0 for an event in
    full, else the number of further ones. `monitor` is the one that acted, for a change the last one; `changed_by` in
    the detail names the events of all (in a count: if it was more than one monitor). `host` and `caller_id` are those
    of the message's sender: publisher, client or server (in a count: empty if there were several of one host); empty
    for timed events. `number`, `seq` and `stamp` in the detail identify the message.
    """

    kind: str
    monitor: str
    key: str
    resource: str
    time: int
    text: str
    detail: dict[str, Any]
    before: bytes = b""
    after: bytes = b""
    size: int = 0
    count: int = 0
    host: str = ""
    caller_id: str = ""


class MonitorsReported(Message):
    """Events of monitors; batches, a few a second at most. `lost` is the number that could not be kept without a
    control.
    """

    events: list[MonitorEvent]
    lost: int = 0


class MonitorRow(msgspec.Struct, frozen=True, array_like=True):
    """The state and counters of one running monitor; counters since it was loaded or the relay started.

    For a monitor in shadow mode (`shadow`), drops and changes are those that it would have made, and `missed` counts
    messages that it would have received if it were in force. A parametric specification has `slices` slices now, and at
    most `slice_limit`.
    """

    name: str
    file: str
    enabled: bool
    held: bool
    failing: bool
    events: int
    verdicts: int
    drops: int
    changes: int
    faults: int
    shadow: bool = False
    missed: int = 0
    slices: int = 0
    slice_limit: int = 0


class MonitorsCounted(Message):
    """All monitors; once a second at most, when something has changed."""

    rows: list[MonitorRow]


class LookWanted(Message):
    """An operator wants the next messages of a topic, at most `messages`, with or without the `latched` one first."""

    number: int
    topic: str
    messages: int
    latched: bool


class LookEnded(Message):
    """The tap with this number is over."""

    number: int


class MessageSeen(Message):
    """A message of a tap, as subscribers get it: `time` in nanoseconds since the epoch, its type, its size in bytes.

    Long `fields` are shortened; `why` is the reason if there are only the first bytes.
    """

    number: int
    key: str
    time: int
    type: str
    size: int
    fields: dict[str, Any]
    why: str = ""


RelayLink = (
    StateBegan | StateEnded | NodePlaced | NodeWithdrawn | PublicationPlaced | PublicationWithdrawn
    | ServicePlaced | ServiceWithdrawn | GrantInstalled | GrantRevoked | ClientGranted | ClientRevoked
    | UpstreamWanted | UpstreamFound | UpstreamRefused | UpstreamLost | LatchRefused | ConnectionOpened
    | MessagesLimited | ConnectionClosed | ConnectionRefused | TrafficReported | SpecificationsStated
    | MonitorSwitched | MonitorResumed | OwnHeaderStated | OwnPublished | SpecificationsTaken
    | SpecificationsRefused | PublicationRefused | MonitorsReported | MonitorsCounted | LookWanted | LookEnded
    | MessageSeen | OrdersAsked | OrdersCarriedOut | OwnServiceCalled | OwnServiceAnswered
)  # fmt: skip
