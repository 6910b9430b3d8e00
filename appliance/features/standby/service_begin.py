"""Begin the service in control: answer operators, and on one of two appliances report that it serves."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from functools import partial

import structlog

from appliance.base import clock
from appliance.channel.status_summary import no_relay
from appliance.control.assembly.assembly import Parts
from appliance.control.assembly.foundation import Foundation
from appliance.control.core import ControlPart
from appliance.control.operators.request_method import RequestMethod
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
    """The service reports of one control process."""

    def __init__(self, base: Foundation, parts: Parts) -> None:
        self._base = base
        self._parts = parts
        self._sound = clock.now()  # when nothing was to be repaired

    def now(self) -> lease_link.ControlServes:
        failed, monitors, settings = self._base.audit.failed, self._parts.monitors, self._base.settings
        # With less, hosts wait before the log fails: records still fit into SQLite's write-ahead file.
        obstacle = lacking_room(settings.state / "control")
        if failed is not None and settings.audit.on_audit_failure == "deny":
            obstacle = f"nothing is granted, because the audit log cannot be written: {failed}"
        keeps_state = any(
            owner.held and monitors.switches.enabled(name) for name, owner in monitors.checked.states.items()
        )
        return lease_link.ControlServes(obstacle or self._lasting(), keeps_state)

    def _lasting(self) -> str:
        probe = self._base.lifeline.surroundings.probe
        broken = no_relay(self._parts.endpoints.relay.presence)
        if probe not in ("", "passed"):
            broken = f"the ROS master is not hidden: {probe}"
        now = clock.now()
        if broken is None:
            self._sound = now
        return broken if broken is not None and now - self._sound > _REPAIR_SECONDS else ""


_SEAL_SECONDS = 0.5  # the robot waits

_log = structlog.get_logger()


async def begin(base: Foundation, parts: Parts) -> ControlPart:
    role = base.role
    if not isinstance(role, PairedRole):
        return _part(StandbyOrders(SingleAppliance(), base.trail))
    pair, replication, rollout = role.pair, role.replication, parts.monitors.rollout
    recorder = await _begin_epoch(base, parts, pair)
    copies = StateCopies(pair, base.store, rollout, replication.followed)

    def save_parameters() -> None:
        mirror = parts.core.parameters
        if mirror.unnoted:  # the standby has all other changes of parameters
            mirror.unnoted = False
            base.store.save_parameters(mirror.tree)

    async def rehearsing() -> None:
        save_parameters()
        await copies.rehearse()

    async def leaving() -> None:
        await leave_state(pair, base.store, rollout)
        save_parameters()
        try:
            async with asyncio.timeout(_SEAL_SECONDS):
                await recorder.handed_over(pair.epoch)
        except TimeoutError:
            _log.warning("the log is not sealed before the switchover: the signer does not answer")

    async def report_service() -> None:
        await parts.reconciler.ready.wait()
        await pair.lease.report_service(ServiceReport(base, parts).now)

    active = ActiveAppliance(replication, rehearsing, leaving, partial(keep_state, base.store, rollout))
    orders = StandbyOrders(active, base.trail)
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


async def _begin_epoch(base: Foundation, parts: Parts, pair: Pair) -> TakeoverRecorder:
    name, other = pair.membership.name, pair.membership.other
    recorder = TakeoverRecorder(
        base.trail, base.audit, base.store, base.signing.signed, name=name, other=other
    )
    await recorder.took_over(pair.epoch)
    parts.monitors.rollout.inherit(*inherited_state(pair, base.store))
    return recorder
