"""Control's side of the processes of doors: which door each serves, its sockets, and its reports.

1. A process gets only sockets with the address of its door, and connects only to RVMaster's port and to ports of
   proxy endpoints and relays. At most `_MAX_PENDING` requests for sockets wait at once.
2. A process of a door that was removed or replaced gets `DoorEnded`, and nothing after it. A door that was added
   again counts as a new door, because its tickets and its agent's address are new.
3. A process that got `DoorEnded` must end, and one without its link must be replaced, within `_END_SECONDS`. Otherwise
   the supervisor kills it, so no process keeps a slot.
4. On each new link, a process gets the valid tickets, and ends connections with any other ticket.
"""

import asyncio
import itertools
import socket
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial

from appliance.base import clock
from appliance.base.counted import counted
from appliance.channel import messages
from appliance.channel.channel import Channel, ChannelFullError
from appliance.channel.link import Link
from appliance.configuration.settings import Settings
from appliance.control.core import Core
from appliance.features.doors import door_link
from appliance.features.doors.door_table import DoorRow, DoorTable
from appliance.features.doors.settings import MAX_DOORS, Doors
from appliance.features.doors.view import LATELY_SECONDS, DoorHealth
from appliance.policy.model import Address
from appliance.rpc.server import listen

ROLE = "door"
_CONNECT_SECONDS = 5.0
_END_SECONDS = 5.0
_LONGEST = 1 << 16  # bytes of a message
_MAX_PENDING = 64
_BACKLOG = 128
_MAX_DEATHS = 16
_MAX_HOSTS = 4096  # with a number; then they get new ones
_EVERYWHERE = ("0.0.0.0", "::")  # noqa: S104  compared only


@dataclass(slots=True)
class _Slot:
    link: Link
    counts: door_link.DoorCounted = field(default_factory=door_link.DoorCounted)
    clients: list[door_link.ClientShown] = field(default_factory=list)
    trouble: str = ""
    started: bool = False
    ending: Channel | None = None
    """The channel to a process that got `DoorEnded`."""
    leaving: float | None = None
    """Since when the slot waits for the end of its process, or for a new link."""
    pending: int = 0
    definitions: Mapping[str, str] = field(default_factory=dict)
    restarts: int = 0
    deaths: deque[float] = field(default_factory=lambda: deque(maxlen=_MAX_DEATHS))
    full_since: float | None = None

    def clear(self) -> None:
        self.counts, self.clients = door_link.DoorCounted(), []
        self.started, self.full_since = False, None


class DoorProcesses:
    def __init__(
        self,
        core: Core,
        table: DoorTable,
        *,
        tickets: Callable[[str], list[str]],
        left: Callable[[str, str], None],  # called after connections of a door with a ticket ended
    ) -> None:
        self._core = core
        self._table = table
        self._tickets = tickets
        self._left = left
        self._host_numbers: dict[Address, int] = {}
        self._numbers = itertools.count(1)  # none is used twice, also after hosts were forgotten
        self._settings = core.settings.of(Doors)
        self._tasks: set[asyncio.Task[None]] = set()
        self._slots = [
            _Slot(Link(partial(self._heard, number), partial(self._lost, number)))
            for number in range(MAX_DOORS)
        ]
        for number, slot in enumerate(self._slots):
            core.links.attach(ROLE, slot.link, door_link.DoorLink, index=number, longest=_LONGEST)
        core.policy.on_change(self._policy_changed)
        host = core.settings.listen_address[0]
        self._appliance = self._settings.gateway if host in _EVERYWHERE else host

    def state(self, row: DoorRow) -> tuple[door_link.DoorCounted, str]:
        slot = self._slots[row.slot or 0]
        trouble = self._table.problem or slot.trouble
        return slot.counts, trouble or ("" if slot.started else "its process is starting")

    def clients(self, row: DoorRow) -> list[door_link.ClientShown]:
        return self._slots[row.slot or 0].clients

    def health(self, row: DoorRow) -> DoorHealth:
        slot, now = self._slots[row.slot or 0], clock.now()
        counts = slot.counts
        return DoorHealth(
            name=row.name,
            up=slot.started and not self._table.problem,
            trouble=self._table.problem or slot.trouble,
            connections=counts.connections,
            limit=self._settings.connections,
            full_seconds=0.0 if slot.full_since is None else round(now - slot.full_since, 1),
            received=counts.received,
            sent=counts.sent,
            received_bytes=counts.received_bytes,
            sent_bytes=counts.sent_bytes,
            dropped=counts.dropped,
            refusals=counts.refusals,
            refused_connections=counts.refused,
            restarts=slot.restarts,
            restarts_lately=sum(now - death < LATELY_SECONDS for death in slot.deaths),
        )

    def start(self) -> None:
        for row in self._table.live():
            slot = self._slots[row.slot or 0]
            if not self._table.problem and slot.link.channel is None:
                self._core.links.start(ROLE, row.slot or 0)

    def end(self, row: DoorRow) -> None:
        slot = self._slots[row.slot or 0]
        slot.clear()
        slot.trouble, slot.restarts = "", 0
        slot.deaths.clear()
        self._end_process(slot)

    def _end_process(self, slot: _Slot) -> None:
        if self._send(slot, door_link.DoorEnded()):
            slot.ending, slot.leaving = slot.link.channel, clock.now()

    def end_overdue(self) -> None:
        for number, slot in enumerate(self._slots):
            if slot.link.channel not in (None, slot.ending):
                slot.leaving = None
            elif slot.leaving is not None and clock.now() - slot.leaving >= _END_SECONDS:
                slot.leaving = None
                self._core.links.kill(ROLE, number)
                self.start()

    def end_ticket(self, row: DoorRow, ticket: str, *, replaced: bool) -> None:
        self._send(self._slots[row.slot or 0], door_link.TicketEnded(ticket, replaced))

    def pass_on(self, row: DoorRow, descriptor: int, peer: str, ticket: str) -> bool:
        slot = self._slots[row.slot or 0]
        return slot.started and self._send(slot, door_link.ViewerGiven(peer, ticket), descriptor)

    def _send(self, slot: _Slot, message: messages.Message, *descriptors: int) -> bool:
        try:
            return slot.link.send(message, descriptors)
        except ChannelFullError:
            slot.link.close()
            slot.leaving = clock.now()
            return False

    # --- messages of a process ---

    def _heard(self, number: int, message: object) -> None:
        slot, row = self._slots[number], self._table.in_slot(number)
        if slot.ending is not None and slot.ending is slot.link.channel:
            return
        if row is None or self._table.problem:
            self._end_process(slot)
            return
        match message:
            case door_link.DoorStarted():
                self._begin(slot, row, message)
            case door_link.SocketWanted(request, port):
                self._make(slot, row, request, port)
            case door_link.HostsWanted(request, nodes):
                self._send(slot, door_link.HostsGiven(request, [*map(self._host_number, nodes)]))
            case door_link.DoorCounted():
                slot.counts = message
                full = message.connections >= self._settings.connections
                slot.full_since = (slot.full_since or clock.now()) if full else None
            case door_link.DefinitionsDiffer():
                self._record_definitions(row, message)
            case door_link.ClientsShown(clients):
                slot.clients = clients[: door_link.MAX_SHOWN]
            case door_link.ConnectionsChanged():
                self._record(row, message)
            case _:
                slot.link.close()

    def _host_number(self, node: str) -> int:
        host = self._core.graph.host_of(node)
        if host is None:
            return -1
        if host.is_loopback or any(host in network for network in self._core.policy.current().robot):
            return 0
        if len(self._host_numbers) >= _MAX_HOSTS:
            self._host_numbers.clear()
        return self._host_numbers.setdefault(host, next(self._numbers))

    def _lost(self, number: int, _reason: str) -> None:
        slot, row = self._slots[number], self._table.in_slot(number)
        slot.clear()
        slot.leaving = clock.now()
        ended, slot.ending = slot.ending is not None, None
        if ended:
            self.start()  # the next door of the slot
        elif row is not None and not self._table.problem:
            slot.restarts += 1
            slot.deaths.append(clock.now())
            self._failed(row, f"the process of the door {row.name} ended; its connections ended with it")

    def _begin(self, slot: _Slot, row: DoorRow, process: door_link.DoorStarted) -> None:
        if process.name and (process.name, process.added) != (row.name, row.added):
            self._end_process(slot)  # it served another door of this slot
            return
        slot.started, slot.trouble = True, ""
        given = door_link.DoorGiven(
            row.name,
            row.added,
            row.address,
            self._core.graph.master_port,
            [*self._settings.origins, *_own_origins(self._core.settings)],
            self._settings.connections,
            self._settings.connections_in_ten_seconds,
            self._tickets(row.name),
            self._blocked(),
        )
        slot.definitions = {}
        self._define(slot)
        if self._send(slot, given) and row.port is not None and not process.listens:
            self._listen(slot, row, row.port)

    def blocks_changed(self) -> None:
        for slot in self._slots:
            if slot.started:
                self._send(slot, door_link.BlocksGiven(self._blocked()))

    def _blocked(self) -> list[str]:
        return [*map(str, self._core.hosts.blocks.reasons)]

    def uses_of(self, host: Address) -> Iterator[str]:
        """Yield the connections of a host to each door."""
        for row in self._table.live():
            count = sum(client.peer == str(host) for client in self._slots[row.slot or 0].clients)
            if count:
                yield f"{counted(count, 'connection')} to the door {row.name}"

    def define(self) -> None:
        for slot in self._slots:
            if slot.started:
                self._define(slot)

    def _policy_changed(self) -> None:
        for slot in self._slots:
            if slot.started:
                self._send(slot, door_link.PolicyChanged())

    def _define(self, slot: _Slot) -> None:
        now = self._core.specifications.sources.definitions
        if now != slot.definitions and self._send(slot, door_link.TypesGiven(dict(now))):
            slot.definitions = now

    def _listen(self, slot: _Slot, row: DoorRow, port: int) -> None:
        try:
            listener = listen(self._core.settings.listen_address[0], port)
        except OSError as error:
            if not slot.trouble:
                slot.trouble = (
                    f"port {port} cannot be listened on: {error.strerror}; add the door with another port"
                )
                self._failed(row, f"door {row.name}: {slot.trouble}")
            return
        slot.trouble = ""
        with listener:
            self._send(slot, door_link.AgentListener(row.source), listener.fileno())

    def _failed(self, row: DoorRow, reason: str) -> None:
        self._core.trail.happened("door failed", reason, host=row.address, resource=row.name)

    def retry(self) -> None:
        for row in self._table.live():
            slot = self._slots[row.slot or 0]
            if slot.started and slot.trouble and row.port is not None:
                self._listen(slot, row, row.port)
        self.start()

    # --- sockets ---

    def _make(self, slot: _Slot, row: DoorRow, request: int, port: int) -> None:
        allowed = port in (0, self._core.graph.master_port) or port in self._core.policy.current().ports
        if not allowed or slot.pending >= _MAX_PENDING:
            reason = "too many connections are being made" if allowed else "doors do not connect to this port"
            self._send(slot, door_link.SocketRefused(request, reason))
            return
        slot.pending += 1
        task = asyncio.get_running_loop().create_task(self._given(slot, row, request, port))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _given(self, slot: _Slot, row: DoorRow, request: int, port: int) -> None:
        channel = slot.link.channel
        made = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            made.setblocking(False)
            made.bind((row.address, 0))
            if port:
                async with asyncio.timeout(_CONNECT_SECONDS):
                    await asyncio.get_running_loop().sock_connect(made, (self._appliance, port))
            else:
                made.listen(_BACKLOG)
            message: messages.Message = door_link.SocketGiven(request)
        except OSError as error:  # TimeoutError is one
            message = door_link.SocketRefused(request, error.strerror or "the appliance does not answer")
        finally:
            slot.pending -= 1
        with made:
            if channel is slot.link.channel:
                self._send(slot, message, *([made.fileno()] if message.descriptors else []))

    # --- records ---

    def _record_definitions(self, row: DoorRow, found: door_link.DefinitionsDiffer) -> None:
        hosts = [self._core.graph.host_of(node) for node, _topic in (found.earlier, found.later)]
        earlier, later = (
            f"{node[:200]} ({topic[:200]}, {host or 'gone'})" if node else "ROS or the operator"
            for (node, topic), host in zip((found.earlier, found.later), hosts, strict=True)
        )
        self._core.trail.happened(
            "definitions differ",
            f"{earlier} and {later} define {found.type[:200]} differently with the md5sum {found.md5sum[:32]}; the door"
            f" {row.name} reads each topic as its own publisher defines it",
            host=None if hosts[1] is None else str(hosts[1]),
            caller_id=found.later[0][:200],
            category="topic",
            resource=found.later[1][:200],
            reads=hosts[1] is None,  # without a host there is no quota, so repetitions are only counted
            earlier=found.earlier[0][:200],
            type=found.type[:200],
        )

    def _record(self, row: DoorRow, change: door_link.ConnectionsChanged) -> None:
        happened = partial(
            self._core.trail.happened, host=row.address, resource=row.name, reads=True, peer=change.peer[:64]
        )
        ticket = {"ticket": change.ticket[:12]} if change.ticket else None
        if change.began:
            happened(
                "door connected",
                f"{counted(change.began, 'connection')} to {row.name} began",
                more=ticket,
                count=change.began,
            )
        if change.ended or change.refused:
            self._left(row.name, change.ticket)
        if change.refused:  # of the peer, so unknown hosts are folded as everywhere
            self._core.trail.happened(
                "door entry refused",
                f"{counted(change.refused, 'connection')} to {row.name} refused: {change.reason}",
                host=change.peer[:64] or None,
                decision="deny",
                category="rest",
                resource=row.name,
                more=ticket,
                count=change.refused,
            )
        if change.ended:
            reason = change.reason or "the client left"
            happened(
                "door disconnected",
                f"{counted(change.ended, 'connection')} to {row.name} ended: {reason}",
                more=ticket,
                count=change.ended,
            )


def _own_origins(settings: Settings) -> list[str]:
    if settings.api_address is None:
        return []
    scheme = "https" if settings.api_tls else "http"
    return [f"{scheme}://{name}:{settings.api_address[1]}" for name in settings.rest_names]
