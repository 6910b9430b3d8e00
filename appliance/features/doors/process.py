"""Run the process of a door: its lifeline, its link to control, its node, and its clients' connections.

It outlives control. Without control, the node can make no new connections, because control gives it every socket.
"""

import asyncio
import ipaddress
import os
import socket
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import structlog
import uvloop
from msgspec import Raw

from appliance.base import clock
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.child_process import Child
from appliance.features.doors import door_link
from appliance.features.doors.client_requests import CallOfService
from appliance.features.doors.connections import ClientWriter, ConnectionLimits, DoorConnections
from appliance.features.doors.door_link import MAX_SHOWN, ClientShown, SocketWanted, node_name
from appliance.features.doors.door_memory import ClientMemory, DoorMemory
from appliance.features.doors.door_node import DoorNode, present_time
from appliance.features.doors.foxglove import SUBPROTOCOLS, Foxglove, FoxgloveLimits
from appliance.features.doors.known_types import KnownTypes
from appliance.features.doors.lookout import HostsOf, Lookout
from appliance.features.doors.message_writer import Now
from appliance.features.doors.node_hosts import NodeHosts
from appliance.features.doors.quotas import DOOR_TOPICS
from appliance.features.doors.rosapi import MasterSight, Rosapi
from appliance.features.doors.rosbridge import Rosbridge, RosbridgeLimits
from appliance.features.doors.session import ClientProtocol, DoorSession, SessionOptions
from appliance.features.doors.values import ValueLimits
from appliance.features.doors.viewer_queue import ViewerQueue
from appliance.quotas.peers import ReportShares, peer_key
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.node import NodeLimits, RosNode
from roswire.node.network import BUFFER_BYTES, ByteWriter, ListeningServer, OwnedTasks, Serve
from roswire.standard import standard_definitions

# The network of a door's node, which gets each socket from control (`door_link.py`).

_SECONDS = 10.0


class PassedSockets:
    """A `NodeNetwork` with sockets from control. `ask(message)` sends a request, and returns False without a link."""

    def __init__(self, source: str, ask: Callable[[SocketWanted], bool]) -> None:
        self.source = source
        self._ask = ask
        self._waiting: dict[int, asyncio.Future[socket.socket]] = {}
        self._number = 0

    async def connect(self, host: str, port: int) -> tuple[asyncio.StreamReader, ByteWriter]:
        """Return a connection to a port of the appliance; `host` is ignored."""
        del host
        connection = await self._socket(port)
        return await asyncio.open_connection(sock=connection, limit=BUFFER_BYTES)

    async def receive(self, host: str, port: int, receiver: asyncio.BufferedProtocol) -> None:
        del host
        connection = await self._socket(port)
        await asyncio.get_running_loop().create_connection(lambda: receiver, sock=connection)

    async def serve(self, serve: Serve) -> ListeningServer:
        listener = await self._socket(0)
        return _Server(await asyncio.start_server(serve, sock=listener, limit=BUFFER_BYTES))

    async def _socket(self, port: int) -> socket.socket:
        self._number += 1
        number = self._number
        future = self._waiting[number] = asyncio.get_running_loop().create_future()
        try:
            if not self._ask(SocketWanted(number, port)):
                raise ConnectionRefusedError("the appliance is being restarted")
            async with asyncio.timeout(_SECONDS):
                made: socket.socket = await future
                return made
        finally:
            del self._waiting[number]

    def given(self, number: int, descriptor: int) -> None:
        future = self._waiting.get(number)
        if future is None or future.done():
            os.close(descriptor)
            return
        made = socket.socket(fileno=descriptor)
        made.setblocking(False)
        future.set_result(made)

    def refused(self, number: int, reason: str) -> None:
        future = self._waiting.get(number)
        if future is not None and not future.done():
            future.set_exception(ConnectionRefusedError(reason))

    def lost(self) -> None:
        for number in [*self._waiting]:
            self.refused(number, "the appliance is being restarted")


class _Server:
    def __init__(self, server: asyncio.Server) -> None:
        self._server = server
        self.port = int(server.sockets[0].getsockname()[1])

    def close(self) -> None:
        self._server.close()


# Count the frames and refusals of each connection in the last minute, for operators.

SAMPLE_SECONDS = 5
_SAMPLES = 60 // SAMPLE_SECONDS


class _Counts(NamedTuple):
    received: int
    sent: int
    refusals: int


class CountedClient:
    """A connection with its counts. `queues` gets the queue of its protocol once the protocol is known."""

    def __init__(self, session: DoorSession, peer: str, ticket: str, queues: list[ViewerQueue[Any]]) -> None:
        self.session = session
        self.ticket = ticket
        self.peer = peer
        self._since = clock.Began()
        self._queues = queues
        self._samples: deque[_Counts] = deque([_Counts(0, 0, 0)], maxlen=_SAMPLES)

    @property
    def dropped(self) -> int:
        return sum(queue.dropped for queue in self._queues)

    def _counts(self) -> _Counts:
        return _Counts(self.session.received, self.session.sent, self.session.refusals)

    def sample(self) -> None:
        self._samples.append(self._counts())

    def describe(self) -> ClientShown:
        lately = (now - before for now, before in zip(self._counts(), self._samples[0], strict=True))
        return ClientShown(self.peer, self.ticket, self.session.protocol_name, self._since.date(), *lately)


def describe_clients(clients: Iterable[CountedClient]) -> Iterator[ClientShown]:
    oldest_first = sorted((client.describe() for client in clients), key=lambda one: one.since)
    yield from oldest_first[:MAX_SHOWN]


# Assemble the parts of a door that all its clients share.


def assembled_door(
    node: RosNode,
    types: KnownTypes,
    *,
    most_topics: int,
    calls: ClientMemory,
    hosts: HostsOf,
    now: Callable[[], Now] = present_time,
) -> tuple[DoorNode, Lookout]:
    def answer(request: CallOfService) -> Awaitable[Raw] | None:
        return rosapi.answer(request)

    sight = MasterSight(node, now)
    door = DoorNode(node, types, answer, most_topics=most_topics, calls=calls, hosts=hosts)
    lookout = Lookout(sight, types, door, hosts)
    rosapi = Rosapi(sight, types, lookout)
    return door, lookout


_AGAIN_SECONDS = 1.0
_REPORT_SECONDS = 1.0
_MAX_PEERS = 256  # in one report
_BLOCKED = "this host is blocked by an operator"
_REPLACED = "this person opened the door again and again, which ended the oldest connection"
_log = structlog.get_logger()


def main(lifeline_fd: int, _index: int) -> None:
    uvloop.run(DoorProcess(lifeline_fd).run())


@dataclass(slots=True)
class _Change:
    began: int = 0
    ended: int = 0
    refused: int = 0
    reason: str = ""


def _counts_of(client: CountedClient) -> Counter[str]:
    session = client.session
    return Counter(
        received=session.received, sent=session.sent, dropped=client.dropped, refusals=session.refusals,
        received_bytes=session.received_bytes, sent_bytes=session.sent_bytes,
    )  # fmt: skip


@dataclass(slots=True)
class _Door:
    node: DoorNode
    lookout: Lookout
    memory: DoorMemory


class DoorProcess:
    def __init__(self, lifeline_fd: int) -> None:
        self._child = Child(
            Channel(socket.socket(fileno=lifeline_fd), messages.Lifeline),
            door_link.DoorLink,
            said=self._heard,
            linked=self._on_link,
            lost=lambda _reason: self._network.lost() if self._network is not None else None,
            took=self._took,
        )
        self._given: door_link.DoorGiven | None = None
        self._network: PassedSockets | None = None
        self._hosts = NodeHosts(self._child.tell)
        self._types = KnownTypes(standard_definitions(), ValueLimits())
        self._door: _Door | None = None
        self._connections: DoorConnections | None = None  # also before the node has started
        self._started = asyncio.Event()
        self._over = asyncio.Event()
        self._failure = ""
        self._listens = False
        self._clients: set[CountedClient] = set()
        self._blocked: frozenset[str] = frozenset()
        self._tickets: Counter[str] = Counter()  # connections that control passed on, until they end
        self._shown: list[door_link.ClientShown] = []
        self._changes: dict[tuple[str, str], _Change] = {}
        self._shares = ReportShares(_MAX_PEERS)
        self._totals = Counter[str]()
        self._counted = door_link.DoorCounted()
        self._tasks = OwnedTasks()

    async def run(self) -> None:
        """Raise `SystemExit` if the door must start again."""
        self._child.attach(messages.Ready())
        self._tasks.start(self._report())
        ended = asyncio.ensure_future(self._child.ended.wait())
        await asyncio.wait(
            (ended, asyncio.ensure_future(self._over.wait())), return_when=asyncio.FIRST_COMPLETED
        )
        await self._tasks.close()
        if self._connections is not None:
            await self._connections.close()
        if self._door is not None and not ended.done():
            await self._door.node.close()
        self._child.close()
        if self._failure:
            self._child.fail(self._failure, [])
            raise SystemExit(1)

    # --- control ---

    def _on_link(self) -> None:
        self._counted, self._shown = door_link.DoorCounted(), []  # this control has no counts yet
        name, added = ("", 0.0) if self._given is None else (self._given.name, self._given.added)
        self._child.tell(door_link.DoorStarted(name, added, self._listens))

    def _heard(self, message: object) -> None:
        match message:
            case door_link.DoorGiven():
                if self._given is None:
                    limits = ConnectionLimits(message.connections, message.in_ten_seconds)
                    self._connections = DoorConnections(limits)
                    self._network = PassedSockets(message.address, self._child.tell)
                    self._tasks.start(self._start(message, self._network))
                elif self._given.added != message.added:  # the slot has another door now
                    self._end_door()
                self._given = message
                self._end_tickets(lambda ticket: ticket not in message.tickets)
                self._block(message.blocked)
            case door_link.TypesGiven(definitions):
                self._define(definitions)
            case door_link.PolicyChanged():
                self._policy_changed()
            case door_link.BlocksGiven(hosts):
                self._block(hosts)
            case door_link.DoorEnded():
                self._end_door()
            case door_link.TicketEnded(ticket, replaced):
                self._end_tickets(lambda one: one == ticket, replaced=replaced)
            case _:
                self._on_answer(message)

    def _on_answer(self, message: object) -> None:
        match message:
            case door_link.HostsGiven(number, hosts):
                self._hosts.given(number, hosts)
            case door_link.SocketRefused(number, reason):
                if self._network is not None:
                    self._network.refused(number, reason)

    def _end_door(self) -> None:
        for client in self._clients:
            client.session.revoke("the door was removed")
        self._over.set()

    def _block(self, hosts: list[str]) -> None:
        self._blocked = frozenset(hosts)
        self._policy_changed()  # the door itself may be blocked
        for client in [one for one in self._clients if one.peer in self._blocked]:
            client.session.revoke(_BLOCKED)

    def _policy_changed(self) -> None:
        if self._door is not None:
            self._door.lookout.policy_changed()
            self._door.node.policy_changed()

    def _end_tickets(self, ended: Callable[[str], bool], *, replaced: bool = False) -> None:
        self._tickets = Counter({one: count for one, count in self._tickets.items() if not ended(one)})
        for client in [one for one in self._clients if one.ticket and ended(one.ticket)]:
            if replaced:  # the person still has the right, so the wills are published
                client.session.disconnect(_REPLACED)
            else:
                client.session.revoke("the ticket is over; ask the operator for a new one")

    def _took(self, message: object, descriptors: tuple[int, ...]) -> None:
        match message:
            case door_link.SocketGiven(number) if self._network is not None:
                self._network.given(number, descriptors[0])
            case door_link.AgentListener(source):
                self._listens = True
                self._tasks.start(self._accept(socket.socket(fileno=descriptors[0]), source))
            case door_link.ViewerGiven(peer, ticket) if self._connections is not None:
                peer = str(_plain(peer))
                self._tickets[ticket] += 1
                self._admit(self._connections, descriptors[0], peer, ticket)

    def _define(self, texts: dict[str, str]) -> None:
        try:
            self._types.define(Definitions.from_files(texts))
        except DefinitionError as error:  # the compiler of the specifications checks the same texts
            _log.error("the door keeps its earlier definitions", reason=str(error))

    # --- the node ---

    async def _start(self, given: door_link.DoorGiven, network: PassedSockets) -> None:
        name = node_name(given.name)
        memory = DoorMemory(given.connections)
        waiting, calls = memory.client("the door's messages"), memory.client("the door")
        while self._door is None:
            node = RosNode(
                name,
                f"http://{given.address}:{given.master_port}/",  # control connects to the appliance, whatever it is
                network,
                limits=NodeLimits(),
                shut_down=self._shut_down,
                memory=waiting,
                skipped=self._skip,
            )
            try:
                await node.start()
            except OSError as error:
                _log.warning("the door's node cannot listen; it tries again", reason=str(error))
                await asyncio.sleep(_AGAIN_SECONDS)
                continue
            types = self._types
            door, lookout = assembled_door(
                node, types, most_topics=DOOR_TOPICS.bounds.whole, calls=calls, hosts=self._hosts.of
            )
            self._door = _Door(door, lookout, memory)
        self._started.set()

    def _skip(self) -> None:
        self._totals["dropped"] += 1

    def _shut_down(self, reason: str) -> None:
        self._failure = f"the master ended the node of the door: {reason}"
        self._over.set()

    # --- connections ---

    async def _accept(self, listener: socket.socket, source: str) -> None:
        await self._started.wait()
        allowed = ipaddress.ip_network(source) if source else None
        loop = asyncio.get_running_loop()
        listener.setblocking(False)
        with listener:
            while self._connections is not None:
                try:
                    connection, address = await loop.sock_accept(listener)
                except OSError as error:
                    _log.error("no connection can be accepted", reason=str(error))
                    await asyncio.sleep(_AGAIN_SECONDS)
                    continue
                peer = _plain(address[0])
                if allowed is not None and peer not in allowed:
                    connection.close()
                    self._refused(str(peer), "", f"the agent's address is {source}")
                else:
                    self._admit(self._connections, connection.detach(), str(peer), "")

    def _admit(self, connections: DoorConnections, descriptor: int, peer: str, ticket: str) -> None:
        if peer in self._blocked:
            os.close(descriptor)
            self._refused(peer, ticket, _BLOCKED)
            return
        serve, refused = partial(self._serve, peer, ticket), partial(self._refused, peer, ticket)
        connections.adopt(descriptor, serve, refused, host=peer_key(peer))

    async def _serve(
        self, peer: str, ticket: str, reader: asyncio.StreamReader, writer: ClientWriter
    ) -> None:
        await self._started.wait()
        door, given = self._door, self._given
        over = (
            "the ticket was over before the door could serve"
            if ticket and ticket not in self._tickets
            else ""
        )
        if door is None or given is None or (over := over or (_BLOCKED if peer in self._blocked else "")):
            writer.close()
            self._refused(peer, ticket, over)
            return
        queues: list[ViewerQueue[Any]] = []
        memory = door.memory.client(peer_key(peer))
        session = DoorSession(
            reader,
            writer,
            door=door.node,
            lookout=door.lookout,
            protocols=partial(_protocol, node_name(given.name), queues, memory),
            subprotocols=SUBPROTOCOLS,
            options=SessionOptions(origins=tuple(given.origins)),
            memory=memory,
            opened=partial(self._changed, peer, ticket, began=1),
        )
        client = CountedClient(session, peer, ticket, queues)
        self._clients.add(client)
        try:
            await session.run()
        finally:
            self._clients.discard(client)
            self._totals.update(_counts_of(client))
            (self._ended if session.began else self._refused)(peer, ticket, session.end)

    # --- reports ---

    def _ended(self, peer: str, ticket: str, reason: str) -> None:
        """Report the end of a connection. Control then forgets its visit."""
        self._changed(peer, ticket, ended=1, reason=reason)
        self._left(ticket)

    def _refused(self, peer: str, ticket: str, reason: str) -> None:
        """Report a connection that ended before its handshake."""
        self._changed(peer, ticket, refused=1, reason=reason)
        self._left(ticket)

    def _left(self, ticket: str) -> None:
        self._tickets[ticket] -= 1
        self._tickets = +self._tickets

    def _changed(
        self, peer: str, ticket: str, *, began: int = 0, ended: int = 0, refused: int = 0, reason: str = ""
    ) -> None:
        key = (peer, ticket)
        if key not in self._changes and (rest := self._shares.rest_of(peer)) is not None:
            key = (rest, "")
        change = self._changes.setdefault(key, _Change())
        change.began += began
        change.ended += ended
        change.refused += refused
        change.reason = reason or change.reason

    async def _report(self) -> None:
        for second in range(1 << 62):
            await asyncio.sleep(_REPORT_SECONDS)
            changes = [*self._changes.items()]
            for (peer, ticket), one in changes:
                message = door_link.ConnectionsChanged(
                    peer, ticket, one.began, one.ended, one.refused, one.reason[:300]
                )
                if self._child.tell(message):
                    del self._changes[peer, ticket]
            if not self._changes:
                self._shares.clear()
            for found in self._types.take_differing():
                self._child.tell(door_link.DefinitionsDiffer(*found))
            counted = self._counts()
            if counted != self._counted and self._child.tell(counted):
                self._counted = counted
            self._show_clients(sample=second % SAMPLE_SECONDS == 0, changed=bool(changes))

    def _show_clients(self, *, sample: bool, changed: bool) -> None:
        if not sample and not changed:
            return
        clients = [*describe_clients(self._clients)]
        if clients != self._shown and self._child.tell(door_link.ClientsShown(clients)):
            self._shown = clients
        for client in self._clients if sample else ():
            client.sample()

    def _counts(self) -> door_link.DoorCounted:
        totals = sum(map(_counts_of, self._clients), self._totals)
        refused = self._connections.refused if self._connections is not None else 0
        return door_link.DoorCounted(connections=len(self._clients), refused=refused, **totals)


def _protocol(
    node: str, queues: list[ViewerQueue[Any]], memory: ClientMemory, subprotocol: str | None
) -> ClientProtocol:
    queue: ViewerQueue[Any] = ViewerQueue(memory=memory)
    queues.append(queue)
    if subprotocol is None:
        return Rosbridge(node, RosbridgeLimits(), queue)
    return Foxglove(node, FoxgloveLimits(), queue)


def _plain(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    address = ipaddress.ip_address(text.partition("%")[0])
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return mapped or address
