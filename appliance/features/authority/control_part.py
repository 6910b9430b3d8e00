"""Build the part of control for command authority."""

from functools import partial
from typing import TYPE_CHECKING, Any

from appliance.control.motion_stop import Commands, MotionStop, published_before
from appliance.control.operators.request_method import RequestMethod
from appliance.features.authority import drive_requests as requests
from appliance.features.authority.drive_orders import DriveOrders
from appliance.features.authority.settings import GIVE, TAKE
from appliance.features.feature import FeaturePart
from appliance.master.endpoints.host_signs import host_signs

if TYPE_CHECKING:
    from appliance.control.assembly.assembly import Parts
    from appliance.control.assembly.foundation import Foundation


async def inherit(base: "Foundation", parts: "Parts") -> FeaturePart:
    """Begin without a holder of any group, and stop motions that earlier holders commanded."""
    relay, policy = parts.endpoints.relay, base.policies.policy
    stop = MotionStop(relay.taps.stop, base.trail, policy)
    lost: Commands = set()
    if policy().authority:
        lost = published_before(base.store, lambda _host, topic: policy().commanded(topic) is not None)
    orders = DriveOrders(
        policy,
        base.trail,
        host_signs(parts.core.registry, parts.core.carried),
        stop,
        decide_again=base.policies.decide_again,
        carried_out=relay.carried_out,
        relays_ready=lambda: relay.presence == "connected",
    )

    return FeaturePart(
        methods=request_methods(orders),
        called={TAKE: orders.take_called, GIVE: orders.give_called},
        holders=orders.holders,
        policy_changed=orders.policy_changed,
        work={
            "the leases of command authority": orders.watch,
            "the stop of what was commanded before groups ended": partial(stop.at_start, lost, relay),
        },
    )


def request_methods(orders: DriveOrders) -> tuple[RequestMethod[Any], ...]:
    return (
        RequestMethod(requests.DriveStatus, orders.status),
        RequestMethod(requests.DriveTake, orders.take, who=True, full_disk=True),
        RequestMethod(requests.DriveGive, orders.give, who=True, full_disk=True),
        RequestMethod(requests.DriveAsk, orders.ask, who=True, full_disk=True),
    )
