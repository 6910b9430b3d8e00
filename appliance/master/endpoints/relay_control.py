"""Send the relays their wanted state and the addresses of publishers, and handle their reports.

The wanted state is derived from the registry (nodes, publications, services) and the grants. Each topic and service is
sent to the relay that carries it (`allocation`). A node is sent to all relays that carry its topics or services.

When a relay starts, control sends its whole state between `StateBegan` and `StateEnded`. The relay removes everything
else.
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
from appliance.master.endpoints.node_api import NodeApiClient
from appliance.master.endpoints.node_ports import NodePorts
from appliance.master.endpoints.topic_taps_control import TapRequests
from appliance.master.endpoints.traffic import RelayTraffic
from appliance.master.graph.grants import Grants
from appliance.master.graph.registry import Incarnation, Kind, Registry
from appliance.policy.model import Address, address_of
from appliance.policy.policy import Policy
from appliance.policy.rate_limits import LimitScope, Rate
from appliance.policy.rights import asks_to_call
from appliance.rpc.xmlrpc_client import CallFailedError
from appliance.specifications.allocation import SERVICE, TOPIC, Allocation, Move, Resource
from appliance.specifications.specification_manager import SpecificationManager
from appliance.store.state_file import PermissionRow
from roswire.xmlrpc import Value


class RelayOutbox(Link):
    """The link to relay `index`. A new relay gets the whole state, including all changes while there was no relay.

    Messages with `soon` are batched for some milliseconds, or until the next message without `soon`. A starting node
    registers about ten topics in that time. Batching is safe, because peers connect only with a grant, and grants and
    revocations are sent at once. `orders` sends its question after all earlier messages.
    """

    def __init__(self, index: int, heard: Callable[[Any], None], lost: Callable[[str], None]) -> None:
        super().__init__(heard, lost)
        self.index = index
        self.placed: set[str] = set()  # the keys of incarnations whose port this relay has
        self._epoch = 0
        self._orders: deque[asyncio.Future[None]] = deque()

    def close(self) -> None:
        """Close the link; nothing waits any longer for the relay's orders."""
        super().close()
        self.placed.clear()
        while self._orders:
            self.carried_out()

    def orders(self) -> list[asyncio.Future[None]]:
        """Return a list of one future, which is done when the relay has carried out its orders or has ended.

        The list is empty if the relay is not connected.
        """
        if not self.send(messages.OrdersAsked()):
            return []
        self._orders.append(asyncio.get_running_loop().create_future())
        return [self._orders[-1]]

    def carried_out(self) -> None:
        if not (done := self._orders.popleft()).done():
            done.set_result(None)

    @contextmanager
    def restating(self) -> Iterator[None]:
        """Mark the messages that are sent inside this block as the whole state of the relay."""
        self._epoch += 1
        self.send(messages.StateBegan(self._epoch))
        yield
        self.send(messages.StateEnded(self._epoch))


RELAY_NAME = "/rosrv"
OwnCall = messages.OwnServiceCalled | messages.MonitorCallWanted | messages.ApprovalWanted
OwnAnswer = messages.OwnServiceAnswered | messages.MonitorCallAnswered | messages.ApprovalAnswered
_STOP_SECONDS = 5.0
_KINDS = {TOPIC: Kind.PUBLICATION, SERVICE: Kind.SERVICE}
_WORDS = {kind: word for word, kind in _KINDS.items()}


@dataclass(slots=True)
class RelayControl:
    """Control's end of the links to the relays.

    `broken(incarnation)` is called for lost upstreams. `own_header` is the header of control's own publications.
    `own_call` answers calls of the appliance's own service, and decides calls of monitors and requests that need an
    approval. `monitors()` returns the specifications that relays run.
    """

    registry: Registry
    grants: Grants
    places: NodePorts
    nodes: NodeApiClient
    carried: RelayTraffic
    allocation: Allocation
    policy: Callable[[], Policy]
    monitors: Callable[[], SpecificationManager]
    broken: Callable[[Incarnation], None]
    own_header: messages.OwnHeaderStated | None
    own_call: Callable[[OwnCall], Awaitable[OwnAnswer]]
    _posts: tuple[RelayOutbox, ...] = field(init=False)
    _asking: set[asyncio.Task[None]] = field(default_factory=set)
    _taps: TapRequests = field(default_factory=TapRequests)
    _stops: dict[int, asyncio.Future[list[str]]] = field(default_factory=dict)
    _stop: int = 0

    def __post_init__(self) -> None:
        self._posts = tuple(
            RelayOutbox(index, partial(self._received, index), partial(self._lost, index))
            for index in range(self.allocation.relays)
        )

    @property
    def presence(self) -> str:
        """Return `connected` if all relays are connected, `away` if none is, or the number of missing relays."""
        away = sum(post.channel is None for post in self._posts)
        if not away:
            return "connected"
        return "away" if away == len(self._posts) else f"{away} of {len(self._posts)} are away"

    def port(self, incarnation: Incarnation, kind: Kind, resource: str) -> int:
        return incarnation.relay_ports[self.allocation.of(_WORDS[kind], resource)]

    # --- the links ---

    def attach(self, index: int, channel: Channel) -> None:
        """Serve the link of a new relay, and send it its whole state."""
        post = self._posts[index]
        self.carried.lost(index)
        post.attach(channel)
        # Send the specifications before the topics, so that no message bypasses the monitors.
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
        """Send a message to a relay; return False if it is not connected."""
        return self._posts[relay].send(message)

    def publish(self, message: messages.OwnPublished) -> None:
        self._post(TOPIC, message.topic).send(message)

    async def carried_out(self, topics: Iterable[str] | None = None) -> None:
        """Wait until the relays have carried out their orders: all relays, or those that carry these topics.

        The wait ends with the link to a relay. So it is bounded for a relay that hangs: the supervisor kills the relay
        after `ANSWER_SECONDS` without an answer, and the next one begins with these orders.
        """
        posts = self._posts if topics is None else {self._post(TOPIC, topic) for topic in topics}
        if waiting := [order for post in posts for order in post.orders()]:
            await asyncio.wait(waiting)

    async def stop(self, topic: str) -> list[str]:
        """Have monitors of a topic send their safe messages; return the names of those that have one."""
        return await self._ask_guards(topic, begin=True) or []

    async def guards(self, topic: str) -> list[str] | None:
        """Return the names of monitors with a safe message for a topic; None if its relay does not answer."""
        return await self._ask_guards(topic, begin=False)

    async def _ask_guards(self, topic: str, *, begin: bool) -> list[str] | None:
        self._stop = number = self._stop + 1
        begun: asyncio.Future[list[str]] = asyncio.get_running_loop().create_future()
        self._stops[number] = begun
        try:
            if not self._post(TOPIC, topic).send(messages.StopWanted(number, topic, begin)):
                return None
            async with asyncio.timeout(_STOP_SECONDS):
                return await begun
        except TimeoutError:
            return None
        finally:
            del self._stops[number]

    async def look(
        self, topic: str, count: int, seconds: float, *, latched: bool
    ) -> list[messages.MessageSeen]:
        """Return the next messages of a topic, as its subscribers get them. Raises `TooManyTapsError`."""
        send = self._post(TOPIC, topic).send
        return await self._taps.look(topic, count, seconds, send, latched=latched)

    def carries(self, relay: int, kind: str, resource: str) -> bool:
        return self.allocation.of(kind, resource) == relay

    def live_resources(self) -> set[Resource]:
        return {
            (_WORDS[registration.kind], registration.resource)
            for _incarnation, registration in self.registry.in_order()
            if registration.kind in _WORDS
        }

    def _post(self, kind: str, resource: str) -> RelayOutbox:
        return self._posts[self.allocation.of(kind, resource)]

    # --- what is wanted ---

    def _place(self, post: RelayOutbox, incarnation: Incarnation) -> None:
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
        self, post: RelayOutbox, incarnation: Incarnation, kind: Kind, resource: str, detail: str
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
        post = self._post(row.kind, row.resource)
        if row.kind == TOPIC:
            post.send(_grant(self.policy(), row))
        else:
            named = _names(self.policy(), address_of(row.host))
            asks = asks_to_call(self.policy(), address_of(row.host), row.resource)
            post.send(messages.ClientGranted(row.key, row.resource, row.host, row.caller_id, named, asks))

    def revoke_grant(self, row: PermissionRow) -> None:
        _revoke(self._post(row.kind, row.resource), row)

    def place(self, incarnation: Incarnation, kind: Kind, resource: str, detail: str) -> None:
        self._place_one(self._post(_WORDS[kind], resource), incarnation, kind, resource, detail)

    def withdraw(self, incarnation: Incarnation, kind: Kind, resource: str) -> None:
        _withdraw(self._post(_WORDS[kind], resource), incarnation, kind, resource)

    def withdraw_moving(self, moves: Iterable[Move]) -> None:
        """Withdraw moving topics and services from their old relays, before the new allocation.

        Their grants are also withdrawn: a later revocation goes only to the new relay.
        """
        for move in moves:
            post = self._posts[move.source]
            for incarnation in self.registry.registered(_KINDS[move.kind], move.name):
                _withdraw(post, incarnation, _KINDS[move.kind], move.name)
                for row in self._rows_of(incarnation, move):
                    _revoke(post, row)

    def place_moved(self, moves: Iterable[Move]) -> None:
        """Send moved topics and services with their grants to their new relays, after the new allocation."""
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
        for post in self._posts:
            if incarnation.key in post.placed:
                post.placed.discard(incarnation.key)
                post.send(messages.NodeWithdrawn(incarnation.key))

    def place_node(self, incarnation: Incarnation) -> None:
        for post in self._posts:
            self._place(post, incarnation)

    def _publication(self, incarnation: Incarnation, topic: str, detail: str) -> messages.PublicationPlaced:
        policy = self.policy()
        together = policy.limit(LimitScope.TOPIC, topic)
        return messages.PublicationPlaced(
            incarnation.key,
            topic,
            detail,
            _flow(policy.limit(LimitScope.PUBLISHER, topic, incarnation.host)),
            _flow(together),
            policy.counted_as(incarnation.host) if together else "",
            _names(policy, incarnation.host),
            not (incarnation.own or policy.may_command(topic, incarnation.host)),
        )

    # --- what the relays say ---

    def _received(self, index: int, message: messages.Message) -> None:
        post = self._posts[index]
        match message:
            case (
                messages.UpstreamWanted()
                | messages.OwnServiceCalled()
                | messages.MonitorCallWanted()
                | messages.ApprovalWanted()
            ):
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
            case messages.MessageSeen() | messages.StopBegun():
                self._seen(message)
            case messages.PublicationRefused():
                self.carried.publication_refused(message)
            case _:
                self.monitors().received(message, post.index)

    def _seen(self, message: messages.MessageSeen | messages.StopBegun) -> None:
        if isinstance(message, messages.MessageSeen):
            self._taps.seen(message)
        elif (begun := self._stops.get(message.number)) is not None and not begun.done():
            begun.set_result(message.monitors)

    async def _answer(self, post: RelayOutbox, asked: messages.UpstreamWanted | OwnCall) -> None:
        if isinstance(asked, OwnCall):
            post.send(await self.own_call(asked))
        else:
            await self._find_upstream(post, asked.key, asked.topic)

    def _held_back(self, message: messages.LatchRefused | messages.MessagesLimited) -> None:
        if isinstance(message, messages.MessagesLimited):
            for row in message.rows:
                self.carried.limited(row, self.policy().limit_rule(row.topic) if row.topic else None)
        else:
            incarnation = self.registry.by_key(message.key)
            if incarnation is not None:
                self.carried.latch_refused(message, str(incarnation.host))

    async def _find_upstream(self, post: RelayOutbox, key: str, topic: str) -> None:
        incarnation = self.registry.by_key(key)
        if incarnation is None or (Kind.PUBLICATION, topic) not in incarnation.registrations:
            post.send(messages.UpstreamRefused(key, topic, "the node no longer publishes this topic"))
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
    limit = policy.limit(LimitScope.SUBSCRIBER, row.resource, host)
    return messages.GrantInstalled(
        row.key, row.resource, row.host, row.caller_id, _flow(limit), _names(policy, host)
    )


def _names(policy: Policy, host: Address) -> bool:
    return host.is_loopback or policy.names(host)


def _flow(rate: Rate) -> messages.FlowLimit:
    return messages.FlowLimit(rate.messages, rate.bytes)


def _withdraw(post: RelayOutbox, incarnation: Incarnation, kind: Kind, resource: str) -> None:
    if kind is Kind.PUBLICATION:
        post.send(messages.PublicationWithdrawn(incarnation.key, resource), soon=True)
    else:
        post.send(messages.ServiceWithdrawn(incarnation.key, resource), soon=True)


def _revoke(post: RelayOutbox, row: PermissionRow) -> None:
    if row.kind == TOPIC:
        post.send(messages.GrantRevoked(row.key, row.resource, row.host, row.caller_id))
    else:
        post.send(messages.ClientRevoked(row.key, row.resource, row.host, row.caller_id))


def tcpros_port(answer: Value) -> int:
    """Return the port in a node's answer to `requestTopic`, ignoring the host. Raises `CallFailedError`."""
    match answer:
        case [1, str(), ["TCPROS", str(), int(port)]] if 0 < port < 65536:
            return port
        case [int(), str(text), *_]:
            raise CallFailedError(f"the publisher refused: {text[:200]}")
    raise CallFailedError("the publisher's answer to requestTopic is not valid")
