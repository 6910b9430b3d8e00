"""Build the part of control for guards."""

from appliance.control.core import ControlPart, Core
from appliance.features.guards.driver_check import DriverChecks
from appliance.features.guards.guard_orders import GuardOrders


async def begin(core: Core) -> ControlPart:
    orders = GuardOrders(core.specifications, core.graph.present, core.graph.connections, core.trail)
    checks = DriverChecks(core.specifications, core.trail, core.graph.present, core.links.processes)
    return ControlPart(
        (*orders.methods(), *checks.methods()),
        {
            "the guards": orders.watch,
            "the place of guards": orders.placement.watch,
            "the check of a driver": checks.watch,
        },
        lambda: {"guards": orders.state()},
    )
