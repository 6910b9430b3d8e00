"""Make the part of command authority in control."""

from typing import TYPE_CHECKING, Any

from appliance.control.operators.request_method import RequestMethod
from appliance.features.authority import drive_requests as requests
from appliance.features.authority.drive_orders import DriveOrders, HostSigns
from appliance.features.authority.settings import GIVE, TAKE
from appliance.features.feature import FeaturePart
from appliance.master.graph.registry import Kind
from appliance.policy.model import Address

if TYPE_CHECKING:
    from appliance.control.assembly.assembly import Parts
    from appliance.control.assembly.foundation import Foundation


async def inherit(base: "Foundation", parts: "Parts") -> FeaturePart:
    """Return the part. It begins without a holder of any group."""
    registry, carried, relay = parts.core.registry, parts.core.carried, parts.endpoints.relay

    def live(host: Address) -> bool:
        return any(node.host == host for node in registry.live())

    def moved(host: Address, names: frozenset[str]) -> float:
        times = (
            carried.traffic[node.key, name].moved
            for name in names
            for node in registry.registered(Kind.PUBLICATION, name)
            if node.host == host and (node.key, name) in carried.traffic
        )
        return max(times, default=0.0)

    orders = DriveOrders(
        base.policies.policy,
        base.trail,
        HostSigns(live, moved),
        decide_again=base.policies.decide_again,
        carried_out=relay.carried_out,
        relays_ready=lambda: relay.presence == "connected",
    )
    return FeaturePart(
        methods=request_methods(orders),
        called={TAKE: orders.take_called, GIVE: orders.give_called},
        holders=orders.holders,
        work={"the leases of command authority": orders.watch},
    )


def request_methods(orders: DriveOrders) -> tuple[RequestMethod[Any], ...]:
    """Return the method that answers each request."""
    return (
        RequestMethod(requests.DriveStatus, orders.status),
        RequestMethod(requests.DriveTake, orders.take, who=True, full_disk=True),
        RequestMethod(requests.DriveGive, orders.give, who=True, full_disk=True),
        RequestMethod(requests.DriveAsk, orders.ask, who=True, full_disk=True),
    )
