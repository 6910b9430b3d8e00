"""Begin the service in control: answer operators, and on one of two appliances report that it serves."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from functools import partial

import structlog

from appliance.audit.log.log import AuditLog
from appliance.base import clock
from appliance.channel.messages import StateOwner
from appliance.channel.status_summary import no_relay
from appliance.configuration.settings import Settings
from appliance.control.core import ControlPart
from appliance.control.operators.request_method import RequestMethod
from appliance.control.start_gate import StartingControl
from appliance.control.start_rehearsal import lacking_room
from appliance.features.standby import lease_link
from appliance.features.standby import requests as standby_requests
from appliance.features.standby.inheritance import StateCopies, inherited_state, keep_state, leave_state
from appliance.features.standby.orders import ActiveAppliance, SingleAppliance, StandbyOrders
from appliance.features.standby.paired_role import PairedRole
from appliance.features.standby.replication import Pair
from appliance.features.standby.takeover_record import TakeoverRecorder

_REPAIR_SECONDS = 8.0


class ServiceReport:
    """The service reports of one control process, whose monitors in force have a state if `keeps_state`."""

    def __init__(
        self,
        settings: Settings,
        audit: AuditLog,
        keeps_state: Callable[[], bool],
        *,
        relays: Callable[[], str],
        probe: Callable[[], str],
    ) -> None:
        self._settings, self._audit, self._keeps_state = settings, audit, keeps_state
        self._relays, self._probe = relays, probe
        self._sound = clock.now()  # when nothing was to be repaired

    def now(self) -> lease_link.ControlServes:
        failed, settings = self._audit.failed, self._settings
        # With less, hosts wait before the log fails: records still fit into SQLite's write-ahead file.
        obstacle = lacking_room(settings.state / "control")
        if failed is not None and settings.audit.on_audit_failure == "deny":
            obstacle = f"nothing is granted, because the audit log cannot be written: {failed}"
        return lease_link.ControlServes(obstacle or self._lasting(), self._keeps_state())

    def _lasting(self) -> str:
        probe, broken = self._probe(), no_relay(self._relays())
        if probe not in ("", "passed"):
            broken = f"the ROS master is not hidden: {probe}"
        now = clock.now()
        if broken is None:
            self._sound = now
        return broken if broken is not None and now - self._sound > _REPAIR_SECONDS else ""


def holds_if_lost(states: Mapping[str, StateOwner], enabled: Callable[[str], bool]) -> bool:
    """Return whether a monitor in force would hold topics without its state."""
    return any(owner.held and enabled(name) for name, owner in states.items())


_SEAL_SECONDS = 0.5  # the robot waits

_log = structlog.get_logger()


async def begin(control: StartingControl) -> ControlPart:
    role, store = control.role, control.store
    if not isinstance(role, PairedRole):
        return _part(StandbyOrders(SingleAppliance(), control.trail))
    pair, replication, rollout = role.pair, role.replication, control.monitors.rollout
    recorder = await _begin_epoch(control, pair)
    copies = StateCopies(pair, store, rollout, replication.followed)

    def save_parameters() -> None:
        mirror = control.parameters
        if mirror.unnoted:  # the standby has all other changes of parameters
            mirror.unnoted = False
            store.save_parameters(mirror.tree)

    async def rehearsing() -> None:
        save_parameters()
        await copies.rehearse()

    async def leaving() -> None:
        await leave_state(pair, store, rollout)
        save_parameters()
        try:
            async with asyncio.timeout(_SEAL_SECONDS):
                await recorder.handed_over(pair.epoch)
        except TimeoutError:
            _log.warning("the log is not sealed before the switchover: the signer does not answer")

    async def report_service() -> None:
        await control.ready.wait()
        monitors = control.monitors
        report = ServiceReport(
            control.settings,
            control.audit,
            lambda: holds_if_lost(monitors.checked.states, monitors.switches.enabled),
            relays=control.relays,
            probe=control.probe,
        )
        await pair.lease.report_service(report.now)

    active = ActiveAppliance(replication, rehearsing, leaving, partial(keep_state, store, rollout))
    orders = StandbyOrders(active, control.trail)
    work: dict[str, Callable[[], Awaitable[None]]] = {
        "the replication": replication.run,
        "the copies of monitors' state": copies.run,
        "the orders of the standby": partial(
            orders.obey, replication.switchover_wanted, replication.sender.refuse_switchover
        ),
        "the replication of checkpoints": recorder.follow,
        "the reports to the lease": report_service,
    }
    return replace(_part(orders), status=lambda: {"standby": active.state()}, work=work)


def _part(orders: StandbyOrders) -> ControlPart:
    return ControlPart(
        methods=(
            RequestMethod(standby_requests.StandbyWanted, orders.state, order=False),
            RequestMethod(
                standby_requests.StandbyPromote, orders.promote, who=True, order=False, full_disk=True
            ),
        )
    )


async def _begin_epoch(control: StartingControl, pair: Pair) -> TakeoverRecorder:
    name, other = pair.membership.name, pair.membership.other
    recorder = TakeoverRecorder(
        control.trail, control.audit, control.store, control.signed, name=name, other=other
    )
    await recorder.took_over(pair.epoch)
    control.monitors.rollout.inherit(*inherited_state(pair, control.store))
    return recorder
