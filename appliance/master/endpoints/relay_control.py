"""Decide what the relays carry, send them their wanted state and the addresses of publishers, and handle their reports.

The default, `relay_all` and `stand_ins`, is a security boundary: relays carry all topics and services, and nodes get
only URIs of proxy endpoints. The other modes are faster, but not a boundary: a node that knows a port can send any
request to it.
"""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

import structlog

from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.link import Link
from appliance.channel.messages import RankFreed, RankReported
from appliance.channel.messages.relay_link import RankPlace
from appliance.master.endpoints.delivery import NodeApiClient
from appliance.master.endpoints.topic_taps_control import TapRequests
from appliance.master.endpoints.traffic import RelayTraffic
from appliance.master.graph.graph import Grants
from appliance.master.graph.registry import ENDED, Change, Incarnation, Kind, Life, RegistrationKey, Registry
from appliance.policy.model import Address, Category, address_of
from appliance.policy.policy import Policy
from appliance.policy.rate_limits import NO_LIMIT, LimitScope, Rate
from appliance.policy.rights import asks_to_call
from appliance.rpc.xmlrpc_client import CallFailedError, UnansweredError
from appliance.specifications.allocation import SERVICE, TOPIC, Allocation, Move, Resource
from appliance.specifications.specification_files import CheckedSpecifications
from appliance.store.state_file import PermissionRow
from roswire.xmlrpc import Value

# The drivers of topics with a rank, as the relays last reported them. No I/O.
#
# The reports survive a relay, and the next one begins with them. After a start of control, each topic is `unknown`
# until its relay reports.

UNKNOWN = RankReported("", "", 0, "unknown")


@dataclass(slots=True)
class RankStates:
    """The last reports by topic. `listeners` are called with each new one."""

    send: Callable[[RankFreed], bool]
    """Sends an order to the relay of a topic, and returns whether it is there."""
    listeners: list[Callable[[RankReported], None]] = field(default_factory=list)
    _last: dict[str, RankReported] = field(default_factory=dict)

    def of(self, topic: str) -> RankReported:
        return self._last.get(topic, UNKNOWN)

    def place(self, topic: str, rank: int, free: float) -> RankPlace:
        known = self.of(topic)
        return RankPlace(rank, free, known.key, known.rank, known.standing)

    def reported(self, report: RankReported) -> None:
        if report != self._last.get(report.topic):
            self._last[report.topic] = report
            for listener in self.listeners:
                listener(report)

    def free(self, topic: str) -> bool:
        """Hand a topic back; return False if its relay is away."""
        if not self.send(RankFreed(topic)):
            return False
        self.reported(RankReported(topic, "", self.of(topic).rank, "free"))
        return True

    def keep(self, topics: Collection[str]) -> None:
        """Forget all other topics: the policy gives them no rank."""
        self._last = {topic: report for topic, report in self._last.items() if topic in topics}


class RelayOutbox(Link):
    """The link to relay `index`, with the facts that control has stated: it sends only differences.

    Messages with `soon` are batched for some milliseconds, in which a starting node registers about ten topics. This
    is safe, because peers connect only with a grant, and grants and revocations are sent at once.
    """

    def __init__(self, index: int, heard: Callable[[object], None], lost: Callable[[str], None]) -> None:
        super().__init__(heard, lost)
        self.index = index
        self.stated: dict[str, dict[Change, messages.RelayFact]] = {}  # by key of the node, whose port it has
        self.unstated: dict[Change, None] = {}  # the changes that could not be sent
        self.again: asyncio.TimerHandle | None = None  # the next attempt to send them
        self.epoch = 0  # the number of relays so far
        self._orders: deque[asyncio.Future[None]] = deque()

    def close(self) -> None:
        super().close()
        self.stated.clear()
        while self._orders:
            self.carried_out()

    def orders(self) -> list[asyncio.Future[None]]:
        """Return one future, done when the relay has carried out its orders or has ended; none if it is away."""
        if not self.send(messages.OrdersAsked()):
            return []
        self._orders.append(asyncio.get_running_loop().create_future())
        return [self._orders[-1]]

    def carried_out(self) -> None:
        if not (done := self._orders.popleft()).done():
            done.set_result(None)


RELAY_NAME = "/rosrv"
OwnCall = messages.OwnServiceCalled | messages.MonitorCallWanted | messages.RequestHeld
OwnAnswer = messages.OwnServiceAnswered | messages.MonitorCallAnswered | messages.HeldRequestDecided
_AGAIN_SECONDS = 0.1
_PATIENCE = 4.0
_KINDS = {TOPIC: Kind.PUBLICATION, SERVICE: Kind.SERVICE}
_WORDS = {kind: word for word, kind in _KINDS.items()}

_log = structlog.get_logger()


class RelayMonitors(Protocol):
    """The specifications, as far as the relays are concerned."""

    @property
    def checked(self) -> CheckedSpecifications: ...

    def statement(self, relay: int) -> messages.SpecificationsStated: ...

    def received(self, message: messages.Message, relay: int) -> None: ...

    def relay_lost(self, relay: int) -> None: ...


@dataclass(slots=True)
class RelayControl:
    """Control's end of the links to the relays.

    `descriptor` returns that of the socket that listens at a port of a node.
    `own_call` answers calls of the appliance's own service, and decides monitors' calls and requests that need an
    approval. `own_topics` are the headers of what the appliance's own node publishes, except for monitors.
    """

    registry: Registry
    grants: Grants
    descriptor: Callable[[int], int]
    nodes: NodeApiClient
    carried: RelayTraffic
    allocation: Allocation
    policy: Callable[[], Policy]
    monitors: Callable[[], RelayMonitors]
    broken: Callable[[Incarnation], None]
    own_topics: dict[str, messages.OwnHeaderStated]
    own_call: Callable[[OwnCall], Awaitable[OwnAnswer]]
    relay_all: bool = True
    stand_ins: bool = True
    _posts: tuple[RelayOutbox, ...] = field(init=False)
    _asking: set[asyncio.Task[None]] = field(default_factory=set)
    _moving: set[Resource] = field(default_factory=set)
    _latched: dict[str, messages.OwnPublished] = field(default_factory=dict)
    taps: TapRequests = field(init=False)
    ranks: RankStates = field(init=False)

    def __post_init__(self) -> None:
        self._posts = tuple(
            RelayOutbox(index, partial(self._on_message, index), partial(self._lost, index))
            for index in range(self.allocation.relays)
        )
        self.taps = TapRequests(partial(self.allocation.of, TOPIC), self.send)
        self.ranks = RankStates(lambda order: self._post(TOPIC, order.topic).send(order))

    @property
    def presence(self) -> str:
        away = sum(post.channel is None for post in self._posts)
        if not away:
            return "connected"
        return "away" if away == len(self._posts) else f"{away} of {len(self._posts)} are away"

    def carries_topic(self, topic: str) -> bool:
        policy = self.policy()
        return (
            self.relay_all
            or topic in policy.monitored_topics
            or policy.limit_rule(topic) is not None
            or policy.command_group(topic) is not None
            or policy.asks_for(Category.PUBLISH, topic)
            or self.monitors().checked.of_topic(topic)
        )

    def carries_service(self, service: str) -> bool:
        policy = self.policy()
        return (
            self.relay_all
            or service in policy.monitored_services
            or policy.command_group(service) is not None
            or policy.asks_for(Category.CALL, service)
            or self.monitors().checked.of_service(service)
        )

    def hides_publishers(self, topic: str) -> bool:
        return self.stand_ins or self.carries_topic(topic)

    def port(self, incarnation: Incarnation, kind: Kind, resource: str) -> int:
        return incarnation.relay_ports[self.allocation.of(_WORDS[kind], resource)]

    # --- the links ---

    def attach(self, index: int, channel: Channel) -> None:
        post = self._posts[index]
        self.carried.lost(index)
        post.attach(channel)
        # Send the specifications before the topics, so that no message bypasses the monitors.
        post.send(self.monitors().statement(index))
        for header in self.own_topics.values():
            post.send(header)
        post.epoch += 1
        post.send(messages.StateBegan(post.epoch))
        self._state_all(post, self.registry.live())
        post.send(messages.StateEnded(post.epoch))

    def _lost(self, index: int, _reason: str) -> None:
        self.carried.lost(index)
        self.monitors().relay_lost(index)

    def send(self, message: messages.Message, relay: int) -> bool:
        return self._posts[relay].send(message)

    def publish(self, message: messages.OwnPublished) -> None:
        """Publish a message; on a latching topic, the relay gets the last one again whenever the topic is placed."""
        header = self.own_topics.get(message.topic)
        if header is not None and header.latching:
            self._latched[message.topic] = message
        self._post(TOPIC, message.topic).send(message)

    def begin_own_topic(self, header: messages.OwnHeaderStated) -> None:
        """Let the own node publish a topic once it is registered."""
        self.own_topics[header.topic] = header
        for post in self._posts:
            post.send(header)

    def end_own_topic(self, topic: str) -> None:
        self.own_topics.pop(topic, None)
        self._latched.pop(topic, None)

    async def carried_out(self, topics: Iterable[str] | None = None) -> None:
        """Wait until the relays, or those that carry these topics, have carried out their orders.

        The supervisor kills a relay that does not answer, and the next one begins with these orders.
        """
        posts = self._posts if topics is None else {self._post(TOPIC, topic) for topic in topics}
        while any(post.unstated for post in posts):
            await asyncio.sleep(_AGAIN_SECONDS)
        if waiting := [order for post in posts for order in post.orders()]:
            await asyncio.wait(waiting)

    def live_resources(self) -> set[Resource]:
        return {
            (_WORDS[registration.kind], registration.resource)
            for _incarnation, registration in self.registry.in_order()
            if registration.kind in _WORDS
        }

    def _post(self, kind: str, resource: str) -> RelayOutbox:
        return self._posts[self.allocation.of(kind, resource)]

    # --- what is wanted ---

    def flush(self, changed: Iterable[Change]) -> None:
        changes = list(changed)
        for post in self._posts:
            self._state_all(post, changes)
        for node in changes:
            if isinstance(node, Incarnation) and node.life in ENDED:
                self.carried.forgotten(node.key)

    def compare(self) -> None:
        self.flush(self.registry.live())

    def withdraw_moving(self, moves: Sequence[Move]) -> None:
        self._moving |= {(move.kind, move.name) for move in moves}
        self.flush(self._move(moves))

    def place_moved(self, moves: Sequence[Move]) -> None:
        self._moving -= {(move.kind, move.name) for move in moves}
        self.flush(self._move(moves))

    def _move(self, moves: Iterable[Move]) -> Iterator[Change]:
        for move in moves:
            for node in list(self.registry.registrants(_KINDS[move.kind], move.name)):
                yield RegistrationKey(node, _KINDS[move.kind], move.name)
                for row in list(self.grants.of(node.key)):
                    if (row.kind, row.resource) == (move.kind, move.name):
                        yield row

    def _state_all(self, post: RelayOutbox, changes: Iterable[Change] = ()) -> None:
        post.unstated |= dict.fromkeys(changes)
        why = ""
        for change in list(post.unstated):
            if post.channel is not None and post.channel.crowded:
                why = "it does not read"
                break
            try:
                self._state(post, change)
                del post.unstated[change]
            except OSError as error:  # no descriptor for the port of this node
                why = str(error)
        if post.again is not None:
            post.again.cancel()
        elif why:
            _log.error("a relay cannot be sent all changes", relay=post.index, error=why)
        loop = asyncio.get_running_loop()
        post.again = loop.call_later(_AGAIN_SECONDS, self._state_all, post) if post.unstated else None

    def _state(self, post: RelayOutbox, change: Change) -> None:
        match change:
            case Incarnation():
                self._state_node(post, change)
            case RegistrationKey(node, kind, _resource, shelved):
                if kind in _WORDS and not shelved:
                    self._state_fact(post, node, change, self._place(post, change))
            case PermissionRow():
                provider = self.registry.by_key(change.key)
                if provider is not None:
                    self._state_fact(post, provider, change, self._granted(post, provider, change))

    def _state_node(self, post: RelayOutbox, node: Incarnation) -> None:
        if node.life is Life.LIVE:
            for kind, resource in node.registrations:
                self._state(post, RegistrationKey(node, kind, resource))
            for row in self.grants.of(node.key):
                self._state(post, row)
        elif node.key in post.stated:
            post.send(messages.FactWithdrawn(("node", node.key)))
            del post.stated[node.key]

    def _state_fact(
        self, post: RelayOutbox, node: Incarnation, fact: Change, wanted: messages.RelayFact | None
    ) -> None:
        before = post.stated.get(node.key, {}).get(fact)
        if wanted == before or post.channel is None:
            return
        soon = isinstance(fact, RegistrationKey)
        if wanted is not None:
            if node.key not in post.stated:
                self._place_node(post, node)
            post.send(wanted, soon=soon)
            post.stated[node.key][fact] = wanted
            if node.of_monitors and isinstance(fact, RegistrationKey) and fact.resource in self._latched:
                post.send(self._latched[fact.resource], soon=True)
        elif before is not None:
            post.send(messages.FactWithdrawn(messages.identity(before)), soon=soon)
            del post.stated[node.key][fact]

    def _place_node(self, post: RelayOutbox, node: Incarnation) -> None:
        listening = self.descriptor(node.relay_ports[post.index])
        placed = messages.NodePlaced(node.key, node.name, str(node.host), node.of_monitors)
        post.send(placed, (listening,), soon=True)
        post.stated[node.key] = {}

    def _carries(self, post: RelayOutbox, resource: Resource) -> bool:
        return resource not in self._moving and self.allocation.of(*resource) == post.index

    def _place(self, post: RelayOutbox, fact: RegistrationKey) -> messages.RelayFact | None:
        node, kind, resource, _shelved = fact
        registration = node.registrations.get((kind, resource)) if node.life is Life.LIVE else None
        if registration is None or not self._carries(post, (_WORDS[kind], resource)):
            return None
        if kind is Kind.SERVICE:
            return messages.ServicePlaced(node.key, resource, str(node.host), int(registration.detail))
        policy = self.policy()
        together = policy.limit(LimitScope.TOPIC, resource)
        group, rank = policy.command_group(resource), None
        if group is not None and group.ranks and not node.own:
            place = group.rank(policy.atoms_of(node.host), node.name)
            rank = None if place is None else self.ranks.place(resource, place, group.free)
            may_command = rank is not None
        else:
            may_command = node.own or policy.may_command(resource, node.host)
        return messages.PublicationPlaced(
            node.key,
            resource,
            registration.detail,
            _flow(policy.limit(LimitScope.PUBLISHER, resource, node.host)),
            _flow(together),
            policy.counted_as(node.host) if together is not NO_LIMIT else "",
            _names(policy, node.host),
            not may_command,
            rank,
            group is not None or (node.host, Category.PUBLISH, resource) in (policy.approved or ()),
        )

    def _granted(self, post: RelayOutbox, node: Incarnation, row: PermissionRow) -> messages.RelayFact | None:
        stands = node.life is Life.LIVE and row in self.grants.of(row.key)
        if not stands or not self._carries(post, (row.kind, row.resource)):
            return None
        policy, host = self.policy(), address_of(row.host)
        about, named = (row.key, row.resource, row.host, row.caller_id), _names(policy, host)
        if row.kind == SERVICE:
            return messages.ClientGranted(*about, named, asks_to_call(policy, host, row.resource))
        limit = policy.limit(LimitScope.SUBSCRIBER, row.resource, host)
        return messages.GrantInstalled(*about, _flow(limit), named)

    # --- what the relays say ---

    def _on_message(self, index: int, message: messages.Message) -> None:
        post = self._posts[index]
        match message:
            case _ if isinstance(message, messages.UpstreamWanted | OwnCall):
                task = asyncio.get_running_loop().create_task(self._answer(post, message))
                self._asking.add(task)
                task.add_done_callback(self._asking.discard)
            case messages.UpstreamLost():
                if (node := self.registry.by_key(message.key)) is not None:
                    self.carried.upstream_lost(message, str(node.host))
                    self.broken(node)
            case messages.MessagesLimited():
                for row in message.rows:
                    self.carried.limited(row, self.policy().limit_rule(row.topic) if row.topic else None)
            case messages.RankReported():
                if self._post(TOPIC, message.topic) is post:
                    self.ranks.reported(message)
            case messages.OrdersCarriedOut():
                post.carried_out()
            case messages.MessageSeen() | messages.StopBegun() | messages.GuardTested():
                self.taps.seen(message, index)
            case _ if not self.carried.received(index, message):
                self.monitors().received(message, index)

    async def _answer(self, post: RelayOutbox, asked: messages.UpstreamWanted | OwnCall) -> None:
        if isinstance(asked, OwnCall):
            post.send(await self.own_call(asked))
        else:
            await self._find_upstream(post, asked.key, asked.topic)

    async def _find_upstream(self, post: RelayOutbox, key: str, topic: str) -> None:
        incarnation = self.registry.by_key(key)
        if incarnation is None or (Kind.PUBLICATION, topic) not in incarnation.registrations:
            post.send(messages.UpstreamRefused(key, topic, "the node no longer publishes this topic"))
            return
        try:
            port = tcpros_port(await self._request_topic(incarnation, topic))
        except CallFailedError as error:
            post.send(messages.UpstreamRefused(key, topic, str(error)))
            self.broken(incarnation)
            return
        post.send(messages.UpstreamFound(key, topic, str(incarnation.host), port))

    async def _request_topic(self, incarnation: Incarnation, topic: str) -> Value:
        """Ask for a publisher's address; a slow node gets longer, because a subscriber of ROS waits without a limit."""
        try:
            return await self.nodes.call(incarnation, "requestTopic", RELAY_NAME, topic, [["TCPROS"]])
        except UnansweredError:
            self.broken(incarnation)
            client = self.nodes.client(incarnation, patience=_PATIENCE)
            return await client.call("requestTopic", RELAY_NAME, topic, [["TCPROS"]])


def _names(policy: Policy, host: Address) -> bool:
    return host.is_loopback or policy.names(host)


def _flow(rate: Rate) -> messages.FlowLimit:
    return messages.FlowLimit(rate.messages, rate.bytes)


def tcpros_port(answer: Value) -> int:
    match answer:
        case [1, str(), ["TCPROS", str(), int(port)]] if 0 < port < 65536:
            return port
        case [int(), str(text), *_]:
            raise CallFailedError(f"the publisher refused: {text[:200]}")
    raise CallFailedError("the publisher's answer to requestTopic is not valid")
