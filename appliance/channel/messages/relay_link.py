"""The link control <-> relay. Control states what is wanted; the relay reports what it sees.

`key` is the key of an incarnation. One file, as each link has: who changes a message sees those that it goes with.
"""

from typing import Any, ClassVar, Literal

import msgspec

from appliance.channel.messages.message import Message


class StateBegan(Message):
    """Control restates everything: what is not said again before `StateEnded` is gone."""

    epoch: int


class StateEnded(Message):
    """End of the restatement that began with the same epoch."""

    epoch: int


class OrdersAsked(Message):
    """Control asks to be told (`OrdersCarriedOut`) when all that it said before this is carried out."""


class OrdersCarriedOut(Message):
    """The relay's answer to `OrdersAsked`: they are answered in order."""


class NodePlaced(Message):
    """An incarnation and the listening socket that stands for its TCPROS port.

    `host` is the address the node is called at, `name` the node's name (its `callerid`). `monitors`: it is the
    appliance's own publisher; what goes out of its port is what monitors publish.
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
    """What may pass in a second: messages, bytes; 0 is without a limit."""

    messages: float = 0.0
    bytes: float = 0.0


UNLIMITED = FlowLimit()


class PublicationPlaced(Message):
    """The incarnation publishes this topic (type as registered, `*` when unknown).

    `limit` is for all publications of the topic on this host, `together` for all of the topic: hosts share that one
    equally, each as `counted_as`. Said again, it changes them. `named`: the policy names the node's host, and not only
    everybody (`*`).
    """

    key: str
    topic: str
    type: str
    limit: FlowLimit = UNLIMITED
    together: FlowLimit = UNLIMITED
    counted_as: str = ""
    named: bool = True


class PublicationWithdrawn(Message):
    """The incarnation publishes this topic no longer: its connections are cut."""

    key: str
    topic: str


class ServicePlaced(Message):
    """The incarnation offers this service at `host:port` (TCPROS)."""

    key: str
    service: str
    host: str
    port: int


class ServiceWithdrawn(Message):
    """The incarnation offers this service no longer: its connections are cut."""

    key: str
    service: str


class GrantInstalled(Message):
    """This subscriber (host, caller_id) may have this topic of that incarnation, up to a limit.

    Said again, it changes the limit. `named`: the policy names the host, and not only everybody (`*`).
    """

    key: str
    topic: str
    host: str
    caller_id: str
    limit: FlowLimit = UNLIMITED
    named: bool = True


class GrantRevoked(Message):
    """The grant is gone; a connection that stands on it is cut."""

    key: str
    topic: str
    host: str
    caller_id: str


class ClientGranted(Message):
    """This client (host, caller_id) may call this service of that incarnation.

    `named`: the policy names the host, and not only everybody (`*`).
    """

    key: str
    service: str
    host: str
    caller_id: str
    named: bool = True


class ClientRevoked(Message):
    """The client may no longer call the service; connections that stand on it are cut."""

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
    """Answer to `UpstreamWanted`: the publisher cannot be asked or said no; the relay asks again later."""

    key: str
    topic: str
    reason: str


Violation = Literal["", "limit exceeded", "malformed", "connection refused"]


class UpstreamLost(Message):
    """A connection to a publisher broke or could not be made: control looks at the node at once.

    `violation` is the event to be recorded if it was cut for what the publisher sent; empty for one that broke.
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
"""So begins the reason of a `ConnectionRefused` for want of a grant, and of no other."""


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
    """Somebody connected to a relay port and was refused; `resource` is the topic or service that the header asked for.

    `kind` is "topic" or "service", and empty as `resource` is for a header that names neither.
    """

    key: str
    kind: str
    resource: str
    host: str
    caller_id: str
    reason: str
    count: int  # repeated identical refusals are folded


DELAY_BOUNDS = (0.00005, 0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.1)
"""Bounds (seconds) of the delays that `TopicTraffic` counts."""


class TopicTraffic(msgspec.Struct, frozen=True, array_like=True):
    """What went through one relayed topic since the last report.

    `delays` counts messages by how long the relay took from receiving them to handing them to the subscribers'
    sockets: up to each of `DELAY_BOUNDS`, and beyond; empty if none was delivered. `delay_seconds` is their sum.
    """

    key: str
    resource: str
    messages: int
    bytes: int
    dropped: int  # at slow subscribers
    subscribers: int
    delays: list[int] = msgspec.field(default_factory=list)
    delay_seconds: float = 0.0


class LimitedRow(msgspec.Struct, frozen=True, array_like=True):
    """Messages of a publication that were dropped since the last report, because they were beyond a limit.

    `part` says whose limit. `host` and `caller_id` are of the publisher, of a subscriber's limit of the subscriber.
    """

    key: str
    topic: str
    part: Literal["publisher", "subscriber", "topic"]
    host: str
    caller_id: str
    messages: int
    bytes: int


class MessagesLimited(Message):
    """What limits of the policy dropped; once a second at most."""

    rows: list[LimitedRow]


class TrafficReported(Message):
    """Counters of all relayed topics and services that changed; once a second at most.

    `over`: the seconds that they are of. `unrecorded` connections came and went without a control, beyond those that
    are told one by one. `memory` has the bytes that all hosts hold now, by what they are.
    """

    rows: list[TopicTraffic]
    over: float = 1.0
    unrecorded: int = 0
    memory: dict[str, int] = msgspec.field(default_factory=dict)


class SpecificationsStated(Message):
    """Control states the specifications in force: before anything is placed, and at every change.

    `part` is what the compiler made for this relay of its specifications (`rosmop/sent.py`; empty: it has none);
    `enabled` says of each monitor of this relay whether its events happen. `restarted`: a relay that has none yet
    takes the place of one that died, so monitors with the modifier `hold` block their topics. So do those in `moved`:
    they come from another relay, and begin here. `statement` is a number of its own for every statement, which the
    answer has, too: the same revision may be stated again. `ahead`: what is stated after it is carried out when it is
    in force (or refused), so that nothing is placed where its monitors are not yet. `trials` are the monitors that are
    on trial: they are given copies of messages. A parametric specification has at most so many `slices`.
    """

    revision: int
    part: bytes
    enabled: dict[str, bool]
    restarted: bool
    on_fault: Literal["drop", "pass"] = "drop"
    moved: tuple[str, ...] = ()
    statement: int = 0
    ahead: bool = False
    trials: tuple[str, ...] = ()
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
    those that hold their topics, `because` why, of those that hold them because their state is lost.
    """

    revision: int
    began: list[str]
    held: list[str]
    statement: int = 0
    because: dict[str, str] = msgspec.field(default_factory=dict)


class SpecificationsRefused(Message):
    """The relay could not take them: what it had stays in force; without any, everything is blocked."""

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
    """What came of a call of the appliance's own service, in words."""

    number: int
    success: bool
    text: str


class PublicationRefused(Message):
    """A publisher (or service) is not carried: its definition is another than the specifications'."""

    key: str
    resource: str
    reason: str


class MonitorEvent(msgspec.Struct, frozen=True, array_like=True):
    """Something a monitor did: the first of its kind and second in full, the others as a count.

    `kind` is verdict, drop, change, fault, log or publish, behind "trial " what one on trial would have done (or
    "trial missed": what it was not given); `time` is nanoseconds since the epoch; `before` and
    `after` are the message, as far as the bound goes (`size` is its whole length). `count` is 0 when told in full,
    else how many more there were. `monitor` is who did it, of a change the last who did; `changed_by` in the detail
    names the events of all (in a count: if it was more than one monitor). `host` and `caller_id` are of the node that
    said the message: publisher, client or server (in a count: empty where several of one host did); empty of what
    happens by time. `number`, `seq` and `stamp` in the detail say which of its messages it was.
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
    """What monitors did; batches, a few a second at most. `lost` could not be kept while there was no control."""

    events: list[MonitorEvent]
    lost: int = 0


class Approach(msgspec.Struct, frozen=True, array_like=True):
    """The sides of a comparison when they were nearest; `time` is nanoseconds since the epoch, to the second."""

    left: float
    right: float
    time: int

    @property
    def distance(self) -> float:
        """Of the sides."""
        return abs(self.left - self.right)


class MarginRow(msgspec.Struct, frozen=True, array_like=True):
    """How close a comparison came while it was true (`holds`) or while it was not: since `load`, and `today` (UTC).

    `threshold` is the side that is a constant, 0 or 1; None if neither is.
    """

    line: int
    column: int
    holds: bool
    threshold: int | None
    load: Approach
    today: Approach | None


class MonitorRow(msgspec.Struct, frozen=True, array_like=True):
    """The state and counters of one running monitor; counters since it was loaded or the relay started.

    Of one on `trial` drops and changes are what it would have done, since it is; `missed` are messages that it was not
    given as others would be. A parametric specification has so many `slices` now, and at most `slice_limit`.
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
    trial: bool = False
    missed: int = 0
    margins: list[MarginRow] = []
    slices: int = 0
    slice_limit: int = 0


class MonitorsCounted(Message):
    """All monitors; once a second at most, when something has changed."""

    rows: list[MonitorRow]


class LookWanted(Message):
    """Somebody wants to see the next messages of a topic, so many at most; the `latched` one first, or not again."""

    number: int
    topic: str
    messages: int
    latched: bool


class LookEnded(Message):
    """The look of this number is over."""

    number: int


class MessageSeen(Message):
    """A message of a look, as subscribers get it: `time` in nanoseconds since 1970, its type and size in bytes.

    `fields` are shortened where they are long; `why` says why there are none but the first bytes.
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
