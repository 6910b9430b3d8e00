"""Answer requests about doors, and pass people's connections to the processes of doors."""

import asyncio
import contextlib
import struct
from collections.abc import Callable, Iterable
from typing import NamedTuple

import structlog

from appliance.base.withdrawal import take_effect
from appliance.channel.answers.limit_answers import LimitUse
from appliance.channel.answers.token_answers import SignedOn
from appliance.channel.messages import OwnHeaderStated, OwnPublished
from appliance.control.assembly.active_role import ActiveRole
from appliance.control.core import Core, RelayOrders
from appliance.control.errors import SenselessError, UnavailableError, UnknownThingError
from appliance.features.doors import requests as door_requests
from appliance.features.doors.door_link import node_name
from appliance.features.doors.door_processes import DoorProcesses
from appliance.features.doors.door_table import DoorRow, DoorTable, TicketRow, is_door_name
from appliance.features.doors.door_visits import DoorTickets, DoorVisits, left_by_its_maker
from appliance.features.doors.settings import MAX_DOORS, Doors
from appliance.features.doors.view import DoorsState
from appliance.policy.model import address_of

# Publish how many viewers each door has: `/rosrv/viewers/NAME`, a latched `std_msgs/UInt32`.
#
# [Subscribers] of the policy decides who may read it, as with any topic. A `-` of the door's name is `_` there.

UINT32 = ("std_msgs/UInt32", "304a39449588c7f8ce2df6e8001c5fce", "uint32 data\n")
"""The type of the topics, its md5sum and its definition."""


class ViewerTopics:
    """The topics of all doors, with the counts that they told last."""

    def __init__(self, relay: RelayOrders, node: str) -> None:
        self._relay = relay
        self._node = node
        self._counts: dict[str, int] = {}  # as published, by door

    def tell(self, counts: Iterable[tuple[str, int]]) -> None:
        """Publish the counts that changed, by the name of the door, and end the topics of all other doors."""
        now = dict(counts)
        if now.keys() != self._counts.keys():
            headers = [OwnHeaderStated(self._topic(name), *UINT32, latching=True) for name in now]
            self._relay.publish_only("doors", headers)
        before, self._counts = self._counts, now
        for name, count in now.items():
            if before.get(name) != count:
                self._relay.publish(OwnPublished(self._topic(name), struct.pack("<I", count)))

    def _topic(self, name: str) -> str:
        return f"{self._node}/viewers/{name.replace('-', '_')}"


# Find the door of a signed-in caller: the door with the token's name, or with the name of a person's group.
#
# An administrator chooses these names. A name that the provider gives a person opens no door, because people can
# choose it at some providers.


class CallerDoor(NamedTuple):
    """The door of a caller; without a `row`, `reason` has the cause and the remedy."""

    name: str
    row: DoorRow | None
    reason: str


class OwnDoors:
    """The doors of all callers; `people()` returns the sessions of people."""

    def __init__(self, table: DoorTable, people: Callable[[], Iterable[SignedOn]]) -> None:
        self._table = table
        self._people = people

    def of(self, who: str) -> CallerDoor:
        groups = self._groups(who)
        names = [name for name in ([who] if groups is None else groups) if is_door_name(name)]
        live = {row.name: row for row in self._table.live()}
        found = next((name for name in names if name in live), None)
        if found is not None:
            return CallerDoor(found, live[found], "")
        if names:
            return CallerDoor(names[0], None, f"you have no door: rosrv door add {names[0]}")
        if groups is None:
            text = f"no door can have the name {who[:80]}: use a token with the name of a door (a-z, 0-9, _ and -)"
        else:
            text = f"no group of {who[:140]} has the name of a door: name one in sso.doors of appliance.yaml"
        return CallerDoor("", None, text)

    def _groups(self, who: str) -> list[str] | None:
        people = [person for person in self._people() if person.name == who]
        return [group for person in people for group in person.groups] if people else None


_LOOK_SECONDS = 1.0
_RETRY_SECONDS = 10
_log = structlog.get_logger()


class DoorOrders:
    """Answers operators, signed-in people, and connections that show a ticket."""

    def __init__(
        self,
        core: Core,
        table: DoorTable,
        *,
        tickets: DoorTickets,
        visits: DoorVisits,
        processes: DoorProcesses,
    ) -> None:
        self._core = core
        self._table = table
        self._settings = core.settings.of(Doors)
        self._tickets = tickets
        self._visits = visits
        self._processes = processes
        self._viewers = ViewerTopics(core.relay, core.settings.publish_as)
        self._own = OwnDoors(table, core.bearers.people)
        self._one = asyncio.Lock()
        # By ticket: the door to which connections were passed, also by an earlier control.
        self._used = {row.id: row.door for row in tickets.valid()}

    async def list_doors(self, _request: door_requests.DoorsWanted) -> door_requests.DoorList:
        return door_requests.DoorList([self._show(row) for row in self._table.live()])

    async def add(self, request: door_requests.DoorAdd, who: str) -> door_requests.DoorState:
        async with self._one:
            if self._table.stray:
                raise UnavailableError(self._table.stray)
            row = self._table.plan(request.name, request.port, request.source)
            if row.port is not None and row.port in self._core.policy.current().ports:
                raise SenselessError(f"port {row.port} is in [Ports] range of the policy: choose another one")
            settings = self._core.settings
            taken = {settings.listen_address[1]: "RVMaster", settings.rosmaster_port: "the ROS master"}
            taken |= {} if settings.api_address is None else {settings.api_address[1]: "REST"}
            if row.port in taken:
                raise SenselessError(f"port {row.port} is that of {taken[row.port]}: choose another one")
            problem = await self._open([*self._table.ports(), *([row.port] if row.port is not None else [])])
            if problem:
                raise UnavailableError(problem)
            take_effect()
            self._table.save(row)
            self._core.policy.hosts_changed()
            self._processes.start()
            self._core.trail.happened(
                "door added",
                f"{row.name} has the address {row.address}",
                host=row.address,
                whole=True,
                resource=row.name,
                who=who,
                address=row.address,
                port=row.port,
                source=row.source,
            )
            await self._core.store.until_settled()
            return self._show(row)

    async def remove(self, request: door_requests.DoorRemove, who: str) -> door_requests.DoorState:
        async with self._one:
            shown = self._show(self._table.of(request.name))
            take_effect()
            row = self._table.remove(request.name)
            self._tickets.forget(row.name)
            self._visits.forget(row.name)
            self._processes.end(row)
            self._core.policy.hosts_changed()
            revoked = self._core.graph.expel(address_of(row.address), f"the door {row.name} was removed")
            self._core.trail.happened(
                "door removed",
                f"{row.name} was removed; {row.address} stays reserved for this name",
                host=row.address,
                whole=True,
                resource=row.name,
                who=who,
                address=row.address,
                port=row.port,
                source=row.source,
                revoked=revoked,
            )
            if row.port is not None and (problem := await self._open(self._table.ports())):
                _log.error("the port of a door stays open in the firewall", port=row.port, reason=problem)
            await self._core.store.until_settled()
            await self._core.relay.carried_out()
            return shown

    async def ticket(self, request: door_requests.DoorTicket, who: str) -> door_requests.NewTicket:
        door = self._table.of(request.name)
        take_effect()
        row, text = self._tickets.make(door.name, request.seconds, who)
        self._record_ticket(
            door, row, f"ticket {row.id} opens the door {door.name} for {request.seconds:g} s"
        )
        await self._core.store.until_settled()
        return _new_ticket(row, text)

    # --- the caller's own door ---

    async def own(self, _request: door_requests.OwnDoorWanted, who: str) -> door_requests.OwnDoor:
        name, row, reason = self._own.of(who)
        return door_requests.OwnDoor(name=name, door=None if row is None else self._show(row), reason=reason)

    async def visit(self, _request: door_requests.DoorVisit, who: str) -> door_requests.NewTicket:
        _name, door, reason = self._own.of(who)
        if door is None:
            raise UnknownThingError(reason)
        take_effect()
        row, text = self._visits.make(door.name, who)
        self._record_ticket(
            door, row, f"ticket {row.id} opens the door {door.name} once, for the session of {who}"
        )
        return _new_ticket(row, text)

    def _record_ticket(self, door: DoorRow, row: TicketRow, text: str) -> None:
        self._core.trail.happened(
            "door ticket made",
            text,
            host=door.address,
            whole=True,
            resource=door.name,
            who=row.who,
            ticket=row.id,
            expires=row.expires,
        )

    # --- connections ---

    async def _open(self, ports: list[int]) -> str:
        problem = await self._core.links.open_own_network(self._settings.network, ports)
        if not problem:
            self._table.closed = ""
        return problem

    def enter(self, door: str, ticket: str, peer: str, descriptor: int) -> tuple[int, str]:
        if self._core.policy.current().block_of(address_of(peer)) is not None:
            self._refuse_entry(peer, door, "the host is blocked by an operator")
            return 403, "this host is blocked by an operator"
        row = next((one for one in self._table.live() if one.name == door), None)
        visit = self._visits.find(door, ticket)
        found = visit or self._tickets.find(door, ticket)
        if row is None or found is None:
            self._refuse_entry(peer, door, "the ticket is wrong, over, or for another door")
            return 401, "the ticket is wrong or over: ask the operator for a new one (rosrv door ticket NAME)"
        if not self._processes.pass_on(row, descriptor, peer, found.id):
            return 503, self._processes.state(row)[1] or "the door is busy: try again"
        if visit is None:
            self._used[found.id] = row.name
        else:
            self._visits.opened(found.id)
        return 101, ""

    def _refuse_entry(self, peer: str, door: str, reason: str) -> None:
        self._core.trail.happened(
            "door entry refused", reason, host=peer, decision="deny", category="rest", resource=door[:31]
        )

    async def watch(self) -> None:
        self._processes.start()
        for number in range(1 << 62):
            await asyncio.sleep(_LOOK_SECONDS)
            self._processes.define()
            self._processes.end_overdue()
            self._viewers.tell(
                (row.name, self._processes.health(row).connections) for row in self._table.live()
            )
            for visit, replaced in self._visits.pop_ended():
                self._end_ticket(visit.door, visit.id, replaced=replaced)
            for ticket in [one for one in self._used if self._tickets.has_ended(one)]:
                self._end_ticket(self._used.pop(ticket), ticket)
            if number % _RETRY_SECONDS == 0:
                with contextlib.suppress(OSError):
                    self._processes.retry()

    def _end_ticket(self, door: str, ticket: str, *, replaced: bool = False) -> None:
        for row in [one for one in self._table.live() if one.name == door]:
            self._processes.end_ticket(row, ticket, replaced=replaced)

    def state(self) -> dict[str, object]:
        rows = self._table.live()
        return {"doors": DoorsState([self._processes.health(row) for row in rows]) if rows else None}

    def limits(self) -> tuple[LimitUse, ...]:
        rows = self._table.live()
        counts = {row.address: self._processes.state(row)[0].connections for row in rows}
        most = max(counts, key=lambda address: counts[address], default="")
        allowed = self._settings.connections
        return (
            LimitUse("doors", len(rows), MAX_DOORS, ""),
            LimitUse(
                "connections of doors",
                sum(counts.values()),
                None,
                "doors.connections",
                most,
                counts.get(most, 0),
                allowed,
            ),
        )

    def _show(self, row: DoorRow) -> door_requests.DoorState:
        counts, trouble = self._processes.state(row)
        return door_requests.DoorState(
            name=row.name,
            address=row.address,
            node=node_name(row.name),
            added=row.added,
            port=row.port,
            source=row.source,
            trouble=trouble,
            warning=missing_port(row.port, self._core.role),
            connections=counts.connections,
            received=counts.received,
            sent=counts.sent,
            dropped=counts.dropped,
            refused=counts.refused,
            tickets=self._valid_tickets(row),
            clients=self._clients(row),
        )

    def _valid_tickets(self, row: DoorRow) -> list[door_requests.Ticket]:
        names = {bearer.name for bearer in self._core.bearers.usable()}
        return [
            door_requests.Ticket(
                ticket.id,
                ticket.created,
                ticket.expires,
                ticket.who,
                warning=left_by_its_maker(ticket, names),
            )
            for ticket in self._tickets.valid(row.name)
        ]

    def _clients(self, row: DoorRow) -> list[door_requests.ConnectedClient]:
        makers = {
            one.id: one.who for one in (*self._tickets.valid(row.name), *self._visits.present(row.name))
        }
        return [
            door_requests.ConnectedClient(
                address=client.peer[:64],
                since=client.since,
                protocol=client.protocol[:32],
                ticket=client.ticket[:12],
                who=makers.get(client.ticket, ""),
                received=client.received,
                sent=client.sent,
                refused=client.refusals,
            )
            for client in self._processes.clients(row)
        ]


def _new_ticket(row: TicketRow, text: str) -> door_requests.NewTicket:
    return door_requests.NewTicket(
        id=row.id,
        created=row.created,
        expires=row.expires,
        who=row.who,
        door=row.door,
        ticket=text,
        path=f"/door/{row.door}?ticket={text}",
    )


def missing_port(port: int | None, role: ActiveRole) -> str:
    if port is None or role.ports is None or any(port in ports for ports in role.ports):
        return ""
    there = ", ".join(f"{one[0]}-{one[-1]}" if len(one) > 1 else str(one[0]) for one in role.ports)
    return (
        f"port {port} does not exist at {role.address}, the fixed address of the two appliances, so an agent there is"
        f" cut off: use a free port of {there}, or make new kits: rosrv standby join … --force --ports …"
    )
