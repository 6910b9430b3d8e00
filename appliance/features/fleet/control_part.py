"""The part of control: the progress of the pusher, the gate of bundles, and the fleet of a pair."""

from appliance.channel.messages import ForwardingLink
from appliance.control.core import ControlPart, Core
from appliance.control.errors import SenselessError
from appliance.control.links.forwarder_link import ForwarderLink
from appliance.control.operators.request_method import RequestMethod
from appliance.features.fleet.bundle_gate import BundleGate
from appliance.features.fleet.bundle_health import RobotHealth
from appliance.features.fleet.bundle_link import BundleLink
from appliance.features.fleet.fleet_of_pair import compare_fleets
from appliance.features.fleet.requests import BundleTake, OrderedBundle
from appliance.features.fleet.settings import POLLER, PUSHER, Fleet

_LONGEST_BUNDLE = 16 << 20


async def begin(core: Core) -> ControlPart:
    fleet = core.settings.of(Fleet)
    if core.role.name:
        compare_fleets(fleet, core.store, core.trail, name=core.role.name)
    pushed_to = fleet.collector if fleet.receipt_key is not None else None
    pushed = ForwarderLink(pushed_to, "all", core.trail, core.links.received)
    gate = BundleGate(
        fleet,
        policies=core.policy.revisions,
        monitors=core.specifications,
        hosts=lambda: core.hosts.enrolment,
        store=core.store,
        trail=core.trail,
        health=lambda deprived: RobotHealth.of(
            core.trail.meter,
            core.policy.current(),
            core.specifications,
            core.links.processes(),
            deprived,
        ),
    )

    async def take(order: BundleTake, who: str) -> OrderedBundle:
        if not gate.order(order.path, who):
            raise SenselessError(f"{order.path} does not wait for an order; see rosrv status")
        return OrderedBundle(order.path, fleet.bundles.confirm_seconds)

    core.links.attach(PUSHER, pushed.link, ForwardingLink)
    core.links.attach(POLLER, gate.link, BundleLink, longest=_LONGEST_BUNDLE)
    return ControlPart(
        (RequestMethod(BundleTake, take, who=True),),
        work={"the bundles": gate.run},
        status=lambda: {"collector": pushed.status(), "bundles": gate.status()},
    )
