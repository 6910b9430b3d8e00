"""The part of control: the progress of the pusher, the gate of bundles, and the fleet of a pair."""

import msgspec

from appliance.channel.messages import ForwardingLink
from appliance.control.core import ControlPart, Core
from appliance.control.errors import SenselessError
from appliance.control.links.forwarder_link import ForwarderLink
from appliance.control.operators.request_method import RequestMethod
from appliance.features.fleet.bundle_gate import BundleGate
from appliance.features.fleet.bundle_health import RobotHealth
from appliance.features.fleet.bundle_link import BundleLink
from appliance.features.fleet.requests import BundleTake, OrderedBundle
from appliance.features.fleet.settings import POLLER, PUSHER, Fleet
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail

# Notice after a takeover that only one appliance of a pair belongs to a fleet.
#
# If the new active appliance is not in the fleet of the earlier one, it pushes no log, and the collector may believe
# that the robot is quiet.

_SETTING = "fleet of the active appliance"


class FleetOfAppliance(msgspec.Struct, frozen=True):
    """The fleet of an appliance; `robot` is empty if it belongs to none."""

    name: str
    robot: str = ""
    collector: str = ""


def compare_fleets(fleet: Fleet, store: StateStore, trail: AuditTrail, *, name: str) -> None:
    own = FleetOfAppliance(name, fleet.robot, fleet.collector or "")
    try:
        last = msgspec.json.decode(store.settings().get(_SETTING, ""), type=FleetOfAppliance)
    except ValueError:  # not stored yet, or by another version
        last = own
    if last.name != name and last.collector and (last.robot, last.collector) != (own.robot, own.collector):
        trail.happened(
            "fleet not joined",
            f"{last.name} is {last.robot or 'enrolled'} at {last.collector}, and {name} is not: it pushes no log there"
            f" and takes no bundles; join also: rosrv-fleet robot invite {last.robot or 'NAME'} --appliance {name}",
            robot=last.robot,
            collector=last.collector,
        )
        return  # the state keeps the fleet until this appliance joins, or the other one leaves
    store.save_setting(_SETTING, msgspec.json.encode(own).decode())


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
