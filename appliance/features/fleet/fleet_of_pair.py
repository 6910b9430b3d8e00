"""Notice after a takeover that only one appliance of a pair belongs to a fleet.

If the new active appliance is not in the fleet of the earlier one, it pushes no log, and the collector may believe
that the robot is quiet.
"""

import msgspec

from appliance.features.fleet.settings import Fleet
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail

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
