"""The link control <-> relay. Control sends the wanted state; the relay reports connections, traffic and events.

`key` is the key of an incarnation. `named`: the policy names the host, not only all hosts (`*`).
"""

from typing import Annotated, Any, ClassVar, Literal

import msgspec

from appliance.channel.messages.compiler import GivenValue
from appliance.channel.messages.message import Message


class StateBegan(Message):
    """Control sends the state again; facts that it does not repeat before `StateEnded` are withdrawn."""

    epoch: int


class StateEnded(Message):
    """The whole state has been sent since the `StateBegan` of this epoch."""

    epoch: int


class OrdersAsked(Message):
    """Control asks when all earlier orders are carried out."""


class OrdersCarriedOut(Message):
    """All orders before an `OrdersAsked` are carried out."""


class NodePlaced(Message):
    """A node, with the listening socket that replaces its TCPROS port.

    `monitors`: the node is the appliance's own publisher of the messages that monitors make.
    """

    descriptors: ClassVar[int] = 1
    key: str
    name: str
    host: str
    monitors: bool = False


class FlowLimit(msgspec.Struct, frozen=True, array_like=True):
    """Limits per second; 0 means unlimited."""

    messages: float = 0.0
    bytes: float = 0.0


UNLIMITED = FlowLimit()

RankStanding = Literal["unknown", "free", "moving", "lost"]
"""Whether the driver of a topic with a rank moves. `lost`: it fell silent after a motion. `unknown`: after a start."""


class RankPlace(msgspec.Struct, frozen=True, array_like=True):
    """The rank of a publication (0 is the highest), the time from a zero to a free topic in seconds, and the last known
    driver of the topic: its key, its rank and its standing.

    A relay uses the driver only if it carries no other ranked publication of the topic yet, so its own state is as old.
    """

    rank: int
    free: float
    driver: str = ""
    driver_rank: int = 0
    standing: RankStanding = "unknown"


class PublicationPlaced(Message):
    """A publication; its type is as registered, or `*` if unknown. Sending it again changes the limits.

    `limit` applies to all publications of the topic on this host. `together` applies to all publications of the topic;
    hosts, by `counted_as`, share it equally. `silent`: the relay drops all messages of the node, because its host does
    not hold the topic's group (`[Authority]`). `rank`: the relay drops the messages while a higher rank moves.
    `wanted`: the host loses a right by silence, so the relay stays connected without a subscriber, and reports silence.
    """

    key: str
    topic: str
    type: str
    limit: FlowLimit = UNLIMITED
    together: FlowLimit = UNLIMITED
    counted_as: str = ""
    named: bool = True
    silent: bool = False
    rank: RankPlace | None = None
    wanted: bool = False


class ServicePlaced(Message):
    """A TCPROS service at `host:port`."""

    key: str
    service: str
    host: str
    port: int


class GrantInstalled(Message):
    """A host and caller id may subscribe, up to a limit, which this message can change."""

    key: str
    topic: str
    host: str
    caller_id: str
    limit: FlowLimit = UNLIMITED
    named: bool = True


class ClientGranted(Message):
    """A host and caller id may call the service; `asks`: control approves each request (`RequestHeld`)."""

    key: str
    service: str
    host: str
    caller_id: str
    named: bool = True
    asks: bool = False


RelayFact = NodePlaced | PublicationPlaced | ServicePlaced | GrantInstalled | ClientGranted
"""A fact that control states and withdraws. The relay keeps the facts in a table (`relay/grant_table.py`)."""


Fact = tuple[str, ...]
"""The identity of a fact: its kind, the key of its incarnation, and the other fields that `_IDENTITIES` names."""

_IDENTITIES: dict[type[RelayFact], tuple[str, ...]] = {
    NodePlaced: ("node", "key"),
    PublicationPlaced: ("publication", "key", "topic"),
    ServicePlaced: ("service", "key", "service"),
    GrantInstalled: ("grant", "key", "topic", "host", "caller_id"),
    ClientGranted: ("client", "key", "service", "host", "caller_id"),
}


def identity(fact: RelayFact) -> Fact:
    kind, *fields = _IDENTITIES[type(fact)]
    return (kind, *(getattr(fact, name) for name in fields))


class FactWithdrawn(Message):
    """A fact ended, and with a node all its facts; the relay cuts the connections that needed them."""

    fact: Fact


class UpstreamWanted(Message):
    """The relay asks for a publisher's TCPROS address, for which control calls `requestTopic`."""

    key: str
    topic: str


class UpstreamFound(Message):
    """The relay may connect to this address."""

    key: str
    topic: str
    host: str
    port: int


class UpstreamRefused(Message):
    """The publisher did not answer, or refused. The relay asks again later."""

    key: str
    topic: str
    reason: str


Violation = Literal["", "limit exceeded", "malformed", "connection refused"]


class UpstreamLost(Message):
    """A connection to a publisher broke or could not be made, so control checks the node at once.

    `violation` is the event to record if the relay cut the connection because of the publisher's data.
    """

    key: str
    topic: str
    reason: str
    violation: Violation = ""


class RankFreed(Message):
    """An operator hands the topic back, so that all ranks may move."""

    topic: str


class RankReported(Message):
    """A ranked topic has another driver, or its driver has another standing. `key` is empty without a driver."""

    topic: str
    key: str
    rank: int
    standing: RankStanding


class LatchRefused(Message):
    """A latched message was not kept, because its host's memory for them is used up."""

    key: str
    topic: str
    size: int


NO_GRANT = "no grant for"
"""The beginning of the reason of each `ConnectionRefused` for lack of a grant, and of no other."""


class ConnectionOpened(Message):
    """A subscriber or client is connected."""

    number: int
    key: str
    resource: str
    kind: str  # "topic" or "service"
    host: str
    caller_id: str


class ConnectionClosed(Message):
    """A connection ended; `reason` is empty for an orderly end."""

    number: int
    reason: str


class ConnectionRefused(Message):
    """A connection was refused. `resource` and `kind` ("topic" or "service") are empty if its header names neither."""

    key: str
    kind: str
    resource: str
    host: str
    caller_id: str
    reason: str
    count: int  # the number of identical refusals


DELAY_BOUNDS = (0.00005, 0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.1)
"""Upper bounds of the histogram in `TopicTraffic`, in seconds."""


class TopicTraffic(msgspec.Struct, frozen=True, array_like=True):
    """Traffic since the last report.

    `delays` counts messages by the time from their receipt to the write to the subscribers' sockets: up to each of
    `DELAY_BOUNDS`, and beyond. `md5sum` is empty while unknown, and for services. `silent`: the seconds in which the
    relay was connected to a `wanted` publication that sent nothing.
    """

    key: str
    resource: str
    messages: int
    bytes: int
    dropped: int  # messages that were dropped for slow subscribers
    subscribers: int
    delays: list[int] = msgspec.field(default_factory=list)
    delay_seconds: float = 0.0
    md5sum: str = ""
    silent: float = 0.0


class LimitedRow(msgspec.Struct, frozen=True, array_like=True):
    """Messages that a limit dropped since the last report.

    `host` and `caller_id` identify the publisher, or, for a subscriber's limit, the subscriber.
    """

    key: str
    topic: str
    part: Literal["publisher", "subscriber", "topic"]
    host: str
    caller_id: str
    messages: int
    bytes: int


class MessagesLimited(Message):
    """The messages that limits dropped, reported at most once a second."""

    rows: list[LimitedRow]


class TrafficReported(Message):
    """Changed counters of topics and services over `over` seconds.

    `unrecorded` counts connections that began and ended while there was no control process. `memory` has the bytes
    that all hosts hold now, by kind.
    """

    rows: list[TopicTraffic]
    over: float = 1.0
    unrecorded: int = 0
    memory: dict[str, int] = msgspec.field(default_factory=dict)


class SpecificationsStated(Message):
    """The specifications in force, sent before any topic is placed, and at every change.

    `part` is empty if this relay runs none of them. If `restarted`, this relay replaces a dead one, so its monitors
    with the modifier `hold` block their topics, as do those in `moved`, which come from another relay.

    The answer repeats `statement`, because the same revision may be sent again. With `ahead`, the relay carries out
    later messages only after these specifications are in force or rejected, so no topic comes before its monitors.

    After a takeover, `left` has the states that the other appliance's relays left (`StateLeft`), `left_at` the time
    of its monitors at that moment (0: the time in the states), and `lost` why other states are lost. The relay then
    ignores its own memory.

    `unbuilt` has the monitors whose files have errors. They hold their topics unless they are declared `begin`.
    `left_out` are files with errors whose monitors do not run at all.
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
    lost: str = ""
    left: tuple[bytes, ...] = ()
    left_at: int = 0
    unbuilt: dict[str, str] = msgspec.field(default_factory=dict)
    given: dict[str, dict[str, GivenValue]] = msgspec.field(default_factory=dict)
    left_out: tuple[str, ...] = ()


class StateWanted(Message):
    """Control asks a relay for `StateLeft`.

    Without `copy`, the appliance hands over: the relay drops all messages from now on. A copy is sent if the state has
    changed since the last copy, or if `full`.
    """

    number: int
    copy: bool = False
    full: bool = False


class StateLeft(Message):
    """The answer to the `StateWanted` with this number.

    `content` is empty if there is no state, and None if it is unchanged since the last copy. `at` is the time of the
    monitors in nanoseconds; without it there is no copy.
    """

    number: int
    content: bytes | None
    at: int = 0


class MonitorSwitched(Message):
    """Control enables or disables a monitor."""

    name: str
    enabled: bool


class MonitorGiven(Message):
    """Control sets given constants; those that `values` lacks get the default of the text."""

    name: str
    values: dict[str, GivenValue]


class MonitorResumed(Message):
    """Control releases the topics that a monitor holds."""

    name: str


class StopWanted(Message):
    """The monitors of a topic send their safe messages until a message comes on it.

    Without `begin`, control only asks which monitors have a safe message.
    """

    number: int
    topic: str
    begin: bool


class StopBegun(Message):
    """The monitors that have a safe message."""

    number: int
    monitors: list[str]


class SpecificationsTaken(Message):
    """The specifications are in force.

    `began` lists the monitors that started in their initial state, `held` those that hold their topics, and `because`
    the reasons if their state was lost.
    """

    revision: int
    began: list[str]
    held: list[str]
    statement: int = 0
    because: dict[str, str] = msgspec.field(default_factory=dict)


class SpecificationsRefused(Message):
    """The relay keeps its present specifications; if it has none, it blocks everything."""

    revision: int
    findings: list[str]
    statement: int = 0


class OwnHeaderStated(Message):
    """The connection header, without names, of a topic of `OwnPublished`."""

    topic: str
    type: str
    md5sum: str
    definition: str
    latching: bool = False


class OwnPublished(Message):
    """A message of the appliance's own publisher, without the length field."""

    topic: str
    data: bytes


class OwnServiceCalled(Message):
    """A client called a service of the appliance, and waits for `OwnServiceAnswered`."""

    number: int
    service: str
    host: str
    caller_id: str


class OwnServiceAnswered(Message):
    """Answer a client. If `repeats`, calls of its host in the next second get the same answer."""

    number: int
    success: bool
    text: str
    repeats: bool = True


class RequestHeld(Message):
    """A client's service request waits for `HeldRequestDecided`.

    `digest` is the SHA-256 of the request, `shown` its first bytes, and `size` its length.
    """

    number: int
    service: str
    host: str
    caller_id: str
    type: str
    digest: str
    shown: bytes
    size: int


class HeldRequestDecided(Message):
    """A request is approved, or `refused` has the reason."""

    number: int
    refused: str


class MonitorCallWanted(Message):
    """A monitor calls a service, and waits for `MonitorCallAnswered`."""

    number: int
    service: str


class MonitorCallAnswered(Message):
    """The node `caller_id` may call the service at `host:port`, a port of its relay; or `refused` has the reason."""

    number: int
    host: str
    port: int
    caller_id: str
    refused: str


class PublicationRefused(Message):
    """The definition differs from the specifications', so the relay does not carry it."""

    key: str
    resource: str
    reason: str


_Count = Annotated[int, msgspec.Meta(ge=0, lt=1 << 32)]


class MonitorEvent(msgspec.Struct, frozen=True, array_like=True):
    """An action of a monitor. The first action of each kind in a second is complete; the others are only counted.

    `kind` is verdict, drop, change, fault, log, publish or call, with the prefix "shadow " in shadow mode ("shadow
    missed": a message that it did not get). `time` is in nanoseconds since the epoch. `count` is 0 for a complete
    event; for a count, `time` is that of the last action, and `first` that of the first one, or 0 if it is unknown.

    `before` and `after` are the first bytes of the message; `size` is its whole length. For a change, `monitor` is
    the last one; `changed_by` in the detail names the events of all. `host` and `caller_id` identify the message's
    sender; they are empty for timed events, and `caller_id` for a count of several senders. `safe`: the monitor stops
    the topic: it sent its safe message there, or put it in the place of the message.
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
    count: _Count = 0
    host: str = ""
    caller_id: str = ""
    safe: bool = False
    first: int = 0


class MonitorsReported(Message):
    """Actions of monitors, sent in batches at most a few times a second.

    `lost` is the number of events that were lost while there was no control process. `ahead` is how far the system
    clock is ahead of the clock of monitors, which gives the times of events, in nanoseconds.
    """

    events: list[MonitorEvent]
    lost: int = 0
    ahead: int = 0


class MonitorRow(msgspec.Struct, array_like=True):
    """A monitor's counters since it was loaded, or the relay started. The relay counts in rows of its own.

    In shadow mode, drops and changes are those that it would have made, and `missed` counts messages that it would
    have received if it were in force. `withholds`: it withholds a topic from hosts now. `awaits`: the nodes without
    whose messages it does not go on. `timed` counts its ticks and the messages that it let pass, `late` those beyond
    `relay.late`; `latest` is the longest delay in seconds.
    """

    name: str
    file: str = ""
    failing: bool = False
    events: int = 0
    verdicts: int = 0
    drops: int = 0
    changes: int = 0
    faults: int = 0
    shadow: bool = False
    missed: int = 0
    slices: int = 0
    slice_limit: int = 0
    withholds: bool = False
    awaits: str = ""
    timed: int = 0
    late: int = 0
    latest: float = 0.0


class MonitorsCounted(Message):
    """The counters of monitors, sent after a change, at most once a second.

    `unfit` is why this relay's part of the heartbeat is off, or empty; `acting` counts its monitors in force that may
    stop, change or withhold messages.
    """

    rows: list[MonitorRow]
    unfit: str = ""
    acting: int = 0


class LookWanted(Message):
    """Control asks for the next messages of a topic. `latched`: the latched message comes first."""

    number: int
    topic: str
    messages: int
    latched: bool


class LookEnded(Message):
    """The tap of the topic has ended."""

    number: int


class ValuesWanted(Message):
    """Control asks for the present variables of a monitor."""

    number: int
    monitor: str


class ValuesSeen(Message):
    """The variables, within limits (`rosmop/run/readout.py`); None if this relay does not run the monitor.

    `ages` has the seconds since the last message of each event whose age the monitor uses; None: never.
    `now_ns` is the time of the monitors' clock.
    """

    number: int
    values: dict[str, object] | None
    ages: dict[str, float | None] = msgspec.field(default_factory=dict)
    now_ns: int | None = None


class SyntheticMessage(msgspec.Struct, array_like=True):
    """A message for the copy of a guard, `after` seconds behind the one before; without a `topic`, only time passes."""

    after: float
    topic: str = ""
    data: bytes = b""
    node: str = ""


class GuardTestWanted(Message):
    """A relay gives messages to a copy of a guard, in the copy's own time; the guard in force does not get them.

    From number `fault` on they must make it stop. If they do, and with `deliver`, the relay writes the safe message of
    the guard once to the subscribers of `command`.
    """

    number: int
    monitor: str
    command: str
    messages: list[SyntheticMessage]
    fault: int
    deliver: bool = False


class SubscriberReached(msgspec.Struct, array_like=True):
    """A subscriber to which a safe message was written.

    `accepted` and `acknowledged` are the seconds from the stimulus until its socket had taken all bytes, and until the
    TCP of its host had acknowledged them; None: not in time.
    """

    node: str
    host: str
    accepted: float | None
    acknowledged: float | None


class GuardTested(Message):
    """The acts of the copy, and whom the safe message reached; `why` is the reason if there was no test.

    `passed`: the last command before the fault passed unchanged. `act` is what the copy did from the fault on:
    `stopped` (its safe message), `limited` or `dropped` a command, `withheld` the topic, or nothing. `after` is the
    copy's own time from the fault to that, `seconds` the real time in which it judged.
    """

    number: int
    why: str = ""
    passed: bool = False
    act: str = ""
    after: float = 0.0
    cause: str = ""
    seconds: float = 0.0
    reached: list[SubscriberReached] = msgspec.field(default_factory=list)


class MessageSeen(Message):
    """A message of a tapped topic; `time` is in nanoseconds since the epoch, `size` in bytes.

    Long `fields` are shortened. If only the first bytes are sent, `why` is the reason.
    """

    number: int
    key: str
    time: int
    type: str
    size: int
    fields: dict[str, object]
    why: str = ""


RelayLink = (
    StateBegan | StateEnded | NodePlaced | PublicationPlaced | ServicePlaced | GrantInstalled | ClientGranted
    | FactWithdrawn
    | UpstreamWanted | UpstreamFound | UpstreamRefused | UpstreamLost | LatchRefused | ConnectionOpened
    | MessagesLimited | ConnectionClosed | ConnectionRefused | TrafficReported | SpecificationsStated
    | StateWanted | StateLeft
    | MonitorSwitched | MonitorGiven | MonitorResumed | OwnHeaderStated | OwnPublished | SpecificationsTaken
    | SpecificationsRefused | PublicationRefused | MonitorsReported | MonitorsCounted | LookWanted | LookEnded
    | MessageSeen | OrdersAsked | OrdersCarriedOut | OwnServiceCalled | OwnServiceAnswered
    | MonitorCallWanted | MonitorCallAnswered | RequestHeld | HeldRequestDecided | StopWanted | StopBegun
    | RankFreed | RankReported | ValuesWanted | ValuesSeen | GuardTestWanted | GuardTested
)  # fmt: skip
