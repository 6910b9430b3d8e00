"""Report to the lease whether the active one of two appliances serves nodes (`features/standby/service_watch.py`).

A full disk is reported at once. A relay that died is back after a second, and a firewall that another program changed
is repaired; they are reported only if they last, because a takeover costs more than the repair.
"""

from appliance.base import clock
from appliance.channel.status_summary import no_relay
from appliance.control.assembly.assembly import Parts
from appliance.control.assembly.foundation import Foundation
from appliance.features.standby import lease_link

_REPAIR_SECONDS = 8.0


class ServiceReport:
    """The reports of one control process."""

    def __init__(self, base: Foundation, parts: Parts) -> None:
        self._base = base
        self._parts = parts
        self._sound = clock.now()  # when nothing was to be repaired

    def now(self) -> lease_link.ControlServes:
        failed, monitors = self._base.audit.failed, self._parts.monitors
        obstacle = ""
        if failed is not None and self._base.settings.audit.on_audit_failure == "deny":
            obstacle = f"nothing is granted, because the audit log cannot be written: {failed}"
        keeps_state = any(
            owner.holds and monitors.switches.enabled(name) for name, owner in monitors.checked.states.items()
        )
        return lease_link.ControlServes(obstacle or self._lasting(), keeps_state)

    def _lasting(self) -> str:
        """Return what should have been repaired by now; empty: nothing."""
        probe = self._base.lifeline.surroundings.probe
        broken = no_relay(self._parts.endpoints.relay.presence)
        if probe not in ("", "passed"):
            broken = f"the ROS master is not hidden: {probe}"
        now = clock.now()
        if broken is None:
            self._sound = now
        return broken if broken is not None and now - self._sound > _REPAIR_SECONDS else ""
