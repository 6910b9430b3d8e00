"""Control's side of the relays: states what is wanted, answers where publishers are.

What is wanted is derived from the registry (nodes, publications, services) and the grants. Each topic and service is
stated to the relay that carries it (`allocation`), a node to every relay that carries something of it. When a relay
(re)appears everything of its is stated afresh between `StateBegan` and `StateEnded`; what is not said again is gone.
"""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.link import Link
from appliance.master.endpoints.endpoint_addresses import Places
from appliance.master.endpoints.node_api import NodeApi
from appliance.master.endpoints.topic_taps_control import TopicLooks
from appliance.master.endpoints.traffic import Carried
from appliance.master.graph.grants import Grants
from appliance.master.graph.registry import Incarnation, Kind, Registry
from appliance.policy.model import Address, address_of
from appliance.policy.policy import Policy
from appliance.policy.rate_limits import Part, Rate
from appliance.rpc.xmlrpc_client import CallFailedError
from appliance.specifications.allocation import SERVICE, TOPIC, Allocation, Move, Resource
from appliance.specifications.specifications import Monitors
from appliance.store.state_file import PermissionRow
from roswire.xmlrpc import Value


class RelayPost(Link):
    """The link to relay `index`. What is sent while nobody is there is stated afresh when somebody is.

    What it is sent `soon` goes some milliseconds later with all that comes until then (a node that starts registers
    ten topics in that time), or before the next thing that is not: nobody connects to what a relay carries without a
    grant, which is told at once, as are revoked grants, and `orders` are asked after all of it.
    """

    def __init__(self, index: int, heard: Callable[[Any], None], lost: Callable[[str], None]) -> None:
        super().__init__(heard, lost)
        self.index = index
        self.placed: set[str] = set()  # incarnations whose port this relay has
        self._epoch = 0
        self._orders: deque[asyncio.Future[None]] = deque()

    def close(self) -> None:
        """As `Link`; nobody waits for its orders any more."""
        super().close()
        self.placed.clear()
        while self._orders:
            self.carried_out()

    def orders(self) -> list[asyncio.Future[None]]:
        """What is done when the relay has carried out all that it was told, or ends; nothing when nobody is there."""
        if not self.send(messages.OrdersAsked()):
            return []
        self._orders.append(asyncio.get_running_loop().create_future())
        return [self._orders[-1]]

    def carried_out(self) -> None:
        """The relay has carried out what it was told before it was asked first."""
        if not (done := self._orders.popleft()).done():
            done.set_result(None)

    @contextmanager
    def restating(self) -> Iterator[None]:
        """What is sent inside is all that the relay is to have."""
        self._epoch += 1
        self.send(messages.StateBegan(self._epoch))
        yield
        self.send(messages.StateEnded(self._epoch))


RELAY_NAME = "/rosrv"
_KINDS = {TOPIC: Kind.PUBLICATION, SERVICE: Kind.SERVICE}
_WORDS = {kind: word for word, kind in _KINDS.items()}


@dataclass(slots=True)
class RelayControl:
    """What control knows and wants of the relays.

    `broken(incarnation)` hears of lost upstreams, `own_header` is of what control publishes itself, `own_call`
    answers calls of the service that the appliance itself offers; `monitors()` are what relays are told and tell of.
    """

    registry: Registry
    grants: Grants
    places: Places
    nodes: NodeApi
    carried: Carried
    allocation: Allocation
    policy: Callable[[], Policy]
    monitors: Callable[[], Monitors]
    broken: Callable[[Incarnation], None]
    own_header: messages.OwnHeaderStated | None
    own_call: Callable[[messages.OwnServiceCalled], Awaitable[messages.OwnServiceAnswered]]
    _posts: tuple[RelayPost, ...] = field(init=False)
    _asking: set[asyncio.Task[None]] = field(default_factory=set)
    _looks: TopicLooks = field(default_factory=TopicLooks)

    def __post_init__(self) -> None:
        """A place for each relay."""
        self._posts = tuple(
            RelayPost(index, partial(self._received, index), partial(self._lost, index))
            for index in range(self.allocation.relays)
        )

    @property
    def presence(self) -> str:
        """`connected` when every relay is there, `away` when none is, else how many are away."""
        away = sum(post.channel is None for post in self._posts)
        if not away:
            return "connected"
        return "away" if away == len(self._posts) else f"{away} of {len(self._posts)} are away"

    def port(self, incarnation: Incarnation, kind: Kind, resource: str) -> int:
        """The port that stands for a publication or a service of an incarnation."""
        return incarnation.relay_ports[self.allocation.of(_WORDS[kind], resource)]

    # --- the links ---

    def attach(self, index: int, channel: Channel) -> None:
        """A relay is there: serve its link and state everything that it is to carry."""
        post = self._posts[index]
        self.carried.lost(index)
        post.attach(channel)
        # Before anything is placed: nothing goes past the monitors
        post.send(self.monitors().statement(index))
        if self.own_header is not None:
            post.send(self.own_header)
        with post.restating():
            for incarnation in self.registry.live():
                self._place(post, incarnation)

    def _lost(self, index: int, _reason: str) -> None:
        self.carried.lost(index)
        self.monitors().relay_lost(index)

    def send(self, message: messages.Message, relay: int) -> bool:
        """Tell a relay; False when it is not there."""
        return self._posts[relay].send(message)

    def publish(self, message: messages.OwnPublished) -> None:
        """Publish as the appliance's own publisher, to whoever subscribes now."""
        self._post(TOPIC, message.topic).send(message)

    async def carried_out(self) -> None:
        """Wait until every relay has carried out what it was told; one that ends or comes meanwhile begins with it."""
        if waiting := [order for post in self._posts for order in post.orders()]:
            await asyncio.wait(waiting)

    async def look(
        self, topic: str, count: int, seconds: float, *, latched: bool
    ) -> list[messages.MessageSeen]:
        """The next messages of a topic, as its subscribers get them. Raises `TooManyLooksError`."""
        send = self._post(TOPIC, topic).send
        return await self._looks.look(topic, count, seconds, send, latched=latched)

    def carries(self, relay: int, kind: str, resource: str) -> bool:
        """Whether a topic or service is carried by this relay."""
        return self.allocation.of(kind, resource) == relay

    def carried_now(self) -> set[Resource]:
        """Topics and services of nodes that live."""
        return {
            (_WORDS[registration.kind], registration.resource)
            for _incarnation, registration in self.registry.in_order()
            if registration.kind in _WORDS
        }

    def _post(self, kind: str, resource: str) -> RelayPost:
        return self._posts[self.allocation.of(kind, resource)]

    # --- what is wanted ---

    def _place(self, post: RelayPost, incarnation: Incarnation) -> None:
        """State what a relay is to carry of an incarnation."""
        for registration in incarnation.registrations.values():
            word = _WORDS.get(registration.kind)
            if word is not None and self.carries(post.index, word, registration.resource):
                self._place_one(
                    post, incarnation, registration.kind, registration.resource, registration.detail
                )
        for row in self.grants.of(incarnation.key):
            if self.carries(post.index, row.kind, row.resource):
                self.place_grant(row)

    def _place_one(
        self, post: RelayPost, incarnation: Incarnation, kind: Kind, resource: str, detail: str
    ) -> None:
        if incarnation.key not in post.placed:
            post.placed.add(incarnation.key)
            listening = self.places.socket(incarnation.relay_ports[post.index])
            post.send(
                messages.NodePlaced(
                    incarnation.key, incarnation.name, str(incarnation.host), incarnation.of_monitors
                ),
                (listening.fileno(),),
                soon=True,
            )
        if kind is Kind.PUBLICATION:
            post.send(self._publication(incarnation, resource, detail), soon=True)
        else:
            placed = messages.ServicePlaced(incarnation.key, resource, str(incarnation.host), int(detail))
            post.send(placed, soon=True)

    def place_grant(self, row: PermissionRow) -> None:
        """A subscriber or client is let in."""
        post = self._post(row.kind, row.resource)
        if row.kind == TOPIC:
            post.send(_grant(self.policy(), row))
        else:
            named = _names(self.policy(), address_of(row.host))
            post.send(messages.ClientGranted(row.key, row.resource, row.host, row.caller_id, named))

    def revoke_grant(self, row: PermissionRow) -> None:
        """A subscriber or client is let in no more; its connection is cut."""
        _revoke(self._post(row.kind, row.resource), row)

    def place(self, incarnation: Incarnation, kind: Kind, resource: str, detail: str) -> None:
        """Carry a publication or a service."""
        self._place_one(self._post(_WORDS[kind], resource), incarnation, kind, resource, detail)

    def withdraw(self, incarnation: Incarnation, kind: Kind, resource: str) -> None:
        """Carry a publication or a service no longer."""
        _withdraw(self._post(_WORDS[kind], resource), incarnation, kind, resource)

    def withdraw_moving(self, moves: Iterable[Move]) -> None:
        """Stop carrying what is about to be carried by another relay; the allocation is still the old one.

        Its grants go, too: one that is revoked later is revoked where it is carried then, and may come back.
        """
        for move in moves:
            post = self._posts[move.source]
            for incarnation in self.registry.registered(_KINDS[move.kind], move.name):
                _withdraw(post, incarnation, _KINDS[move.kind], move.name)
                for row in self._rows_of(incarnation, move):
                    _revoke(post, row)

    def place_moved(self, moves: Iterable[Move]) -> None:
        """Carry what has moved, with its grants; the allocation is the new one."""
        for move in moves:
            kind, post = _KINDS[move.kind], self._posts[move.target]
            for incarnation in self.registry.registered(kind, move.name):
                detail = incarnation.registrations[kind, move.name].detail
                self._place_one(post, incarnation, kind, move.name, detail)
                for row in self._rows_of(incarnation, move):
                    self.place_grant(row)

    def _rows_of(self, incarnation: Incarnation, move: Move) -> list[PermissionRow]:
        rows = self.grants.of(incarnation.key)
        return [row for row in rows if (row.kind, row.resource) == (move.kind, move.name)]

    def withdraw_node(self, incarnation: Incarnation) -> None:
        """Carry nothing of an incarnation."""
        for post in self._posts:
            if incarnation.key in post.placed:
                post.placed.discard(incarnation.key)
                post.send(messages.NodeWithdrawn(incarnation.key))

    def place_node(self, incarnation: Incarnation) -> None:
        """Carry all that an incarnation has."""
        for post in self._posts:
            self._place(post, incarnation)

    def _publication(self, incarnation: Incarnation, topic: str, detail: str) -> messages.PublicationPlaced:
        policy = self.policy()
        together = policy.limit(Part.TOPIC, topic)
        return messages.PublicationPlaced(
            incarnation.key,
            topic,
            detail,
            _flow(policy.limit(Part.PUBLISHER, topic, incarnation.host)),
            _flow(together),
            policy.counted_as(incarnation.host) if together else "",
            _names(policy, incarnation.host),
        )

    # --- what the relays say ---

    def _received(self, index: int, message: messages.Message) -> None:
        post = self._posts[index]
        match message:
            case messages.UpstreamWanted() | messages.OwnServiceCalled():
                task = asyncio.get_running_loop().create_task(self._answer(post, message))
                self._asking.add(task)
                task.add_done_callback(self._asking.discard)
            case messages.UpstreamLost():
                incarnation = self.registry.by_key(message.key)
                if incarnation is not None:
                    self.carried.upstream_lost(message, str(incarnation.host))
                    self.broken(incarnation)
            case messages.LatchRefused() | messages.MessagesLimited():
                self._held_back(message)
            case messages.TrafficReported():
                self.carried.reported(message.rows, message.over)
                self.carried.unrecorded(message.unrecorded)
                self.carried.memory[post.index] = message.memory
            case messages.ConnectionOpened():
                self.carried.opened(post.index, message)
            case messages.ConnectionClosed():
                self.carried.closed(post.index, message)
            case messages.ConnectionRefused():
                self.carried.refused(message)
            case messages.OrdersCarriedOut():
                post.carried_out()
            case messages.MessageSeen():
                self._looks.seen(message)
            case messages.PublicationRefused():
                self.carried.publication_refused(message)
            case _:
                self.monitors().received(message, post.index)

    async def _answer(
        self, post: RelayPost, asked: messages.UpstreamWanted | messages.OwnServiceCalled
    ) -> None:
        if isinstance(asked, messages.OwnServiceCalled):
            post.send(await self.own_call(asked))
        else:
            await self._find_upstream(post, asked.key, asked.topic)

    def _held_back(self, message: messages.LatchRefused | messages.MessagesLimited) -> None:
        """Messages were not kept or not passed on."""
        if isinstance(message, messages.MessagesLimited):
            for row in message.rows:
                self.carried.limited(row, self.policy().limit_rule(row.topic) if row.topic else None)
        else:
            incarnation = self.registry.by_key(message.key)
            if incarnation is not None:
                self.carried.latch_refused(message, str(incarnation.host))

    async def _find_upstream(self, post: RelayPost, key: str, topic: str) -> None:
        incarnation = self.registry.by_key(key)
        if incarnation is None or (Kind.PUBLICATION, topic) not in incarnation.registrations:
            post.send(messages.UpstreamRefused(key, topic, "the node does not publish this topic any more"))
            return
        try:
            answer = await self.nodes.call(incarnation, "requestTopic", RELAY_NAME, topic, [["TCPROS"]])
            port = tcpros_port(answer)
        except CallFailedError as error:
            post.send(messages.UpstreamRefused(key, topic, str(error)))
            self.broken(incarnation)
            return
        post.send(messages.UpstreamFound(key, topic, str(incarnation.host), port))


def _grant(policy: Policy, row: PermissionRow) -> messages.GrantInstalled:
    host = address_of(row.host)
    limit = policy.limit(Part.SUBSCRIBER, row.resource, host)
    return messages.GrantInstalled(
        row.key, row.resource, row.host, row.caller_id, _flow(limit), _names(policy, host)
    )


def _names(policy: Policy, host: Address) -> bool:
    """Whether the policy names a host; it need not name the appliance itself."""
    return host.is_loopback or policy.names(host)


def _flow(rate: Rate) -> messages.FlowLimit:
    return messages.FlowLimit(rate.messages, rate.bytes)


def _withdraw(post: RelayPost, incarnation: Incarnation, kind: Kind, resource: str) -> None:
    if kind is Kind.PUBLICATION:
        post.send(messages.PublicationWithdrawn(incarnation.key, resource), soon=True)
    else:
        post.send(messages.ServiceWithdrawn(incarnation.key, resource), soon=True)


def _revoke(post: RelayPost, row: PermissionRow) -> None:
    if row.kind == TOPIC:
        post.send(messages.GrantRevoked(row.key, row.resource, row.host, row.caller_id))
    else:
        post.send(messages.ClientRevoked(row.key, row.resource, row.host, row.caller_id))


def tcpros_port(answer: Value) -> int:
    """The port in a node's answer to `requestTopic`; the host in it is never followed."""
    match answer:
        case [1, str(), ["TCPROS", str(), int(port)]] if 0 < port < 65536:
            return port
        case [int(), str(text), *_]:
            raise CallFailedError(f"the publisher refused: {text[:200]}")
    raise CallFailedError("the publisher's answer to requestTopic is not of the ROS form")
