"""Build the part of control for doors."""

import structlog

from appliance.control.core import ControlPart, Core
from appliance.control.operators.request_method import RequestMethod
from appliance.features.doors import requests
from appliance.features.doors.door_processes import DoorProcesses
from appliance.features.doors.door_table import DoorTable
from appliance.features.doors.door_visits import DoorTickets, DoorVisits
from appliance.features.doors.orders import DoorOrders
from appliance.features.doors.settings import Doors

_log = structlog.get_logger()


async def begin(core: Core) -> ControlPart:
    """Let the firewall reserve the addresses of doors before the policy names them."""
    settings, blocks = core.settings.of(Doors), core.hosts.blocks
    table = DoorTable(core.store, settings)
    if table.live():
        table.closed = await core.links.open_own_network(settings.network, table.ports())
        if table.problem:
            _log.error("doors cannot be used", reason=table.problem)
    tickets = DoorTickets(core.store, core.ends)
    visits = DoorVisits(core.ends, lambda: {row.id: row.name for row in core.bearers.usable()})
    processes = DoorProcesses(
        core,
        table,
        tickets=lambda door: [row.id for row in (*tickets.valid(door), *visits.present(door))],
        left=visits.left,
    )
    orders = DoorOrders(core, table, tickets=tickets, visits=visits, processes=processes)
    core.policy.provide(lambda known: known.with_hosts(table.addresses()))
    blocks.on_change(processes.blocks_changed)
    blocks.uses.add(processes.uses_of)
    core.rest.websocket(orders.enter)
    core.limits.provide(orders.limits)
    return ControlPart(
        (
            RequestMethod(requests.DoorsWanted, orders.list_doors),
            RequestMethod(requests.DoorAdd, orders.add, who=True),
            RequestMethod(requests.DoorRemove, orders.remove, who=True, full_disk=True),
            RequestMethod(requests.DoorTicket, orders.ticket, who=True),
            RequestMethod(requests.OwnDoorWanted, orders.own, who=True),
            RequestMethod(requests.DoorVisit, orders.visit, who=True, full_disk=True),
        ),
        {"the doors": orders.watch},
        orders.state,
    )
