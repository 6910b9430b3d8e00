"""The part of control: the progress of the pusher, the gate of bundles, and the fleet of a pair."""

from appliance.channel import messages
from appliance.control.links.forwarder_link import ForwarderLink
from appliance.features.feature import FeaturePart, OperatorContext
from appliance.features.fleet.bundle_gate import BundleGate
from appliance.features.fleet.bundle_health import RobotHealth
from appliance.features.fleet.bundle_link import BundleLink
from appliance.features.fleet.fleet_of_pair import compare_fleets
from appliance.features.fleet.settings import POLLER, PUSHER, Fleet

_LONGEST_BUNDLE = 16 << 20


def make_part(context: OperatorContext) -> FeaturePart:
    fleet = context.core.sections.of(Fleet)
    if context.appliance:
        compare_fleets(fleet, context.store, context.core.trail, name=context.appliance)
    pushed_to = fleet.collector if fleet.receipt_key is not None else None
    pushed = ForwarderLink(pushed_to, "all", context.core.trail, context.received)
    gate = BundleGate(
        fleet,
        policies=context.policies,
        monitors=context.monitors,
        hosts=context.hosts,
        store=context.store,
        trail=context.core.trail,
        health=lambda deprived: RobotHealth.of(
            context.core.trail.meter,
            context.policies.current,
            context.monitors,
            context.processes(),
            deprived,
        ),
    )
    return FeaturePart(
        {PUSHER: (pushed.link, messages.ForwardingLink), POLLER: (gate.link, BundleLink)},
        longest={POLLER: _LONGEST_BUNDLE},
        work={"the bundles": gate.run},
        status_fields=lambda: {"collector": pushed.status(), "bundles": gate.status()},
    )
