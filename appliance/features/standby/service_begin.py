"""Begin the service in control: answer operators, and on one of two appliances report that it serves."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TypeVar

import msgspec
import structlog

from appliance.audit.log.log import AuditLog
from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.signatures import KeyUnreadableError, pinned_key_path, read_public_key
from appliance.audit.proof.copies import SignedCheckpoint, newest_checkpoint
from appliance.audit.search.query import Filter
from appliance.audit.search.search import search
from appliance.base import clock
from appliance.channel.messages import StateOwner
from appliance.channel.status_summary import no_relay
from appliance.configuration.settings import Settings
from appliance.control.control import Control
from appliance.control.core import ControlPart
from appliance.control.operators.request_method import RequestMethod
from appliance.control.start_rehearsal import lacking_room
from appliance.features.standby import lease_link
from appliance.features.standby import requests as standby_requests
from appliance.features.standby.inheritance import StateCopies, inherited_state, keep_state, leave_state
from appliance.features.standby.orders import ActiveAppliance, StandbyOrders
from appliance.features.standby.paired_role import PairedRole
from appliance.features.standby.replication import Pair
from appliance.features.standby.takeovers import TOOK_OVER, EpochOf, TookOver
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail

# Record takeovers of a pair of appliances, and replicate the newest signed checkpoint of this appliance's log.
#
# A record names only a valid checkpoint of the other appliance's chain.

_CHECKPOINT = "audit checkpoint of "
_LAST_TAKEOVER = "last takeover"
_T = TypeVar("_T")


class TakeoverRecorder:
    """The recorder of the active appliance `name`, whose partner is `other`.

    `signed` is set with each signature of a checkpoint. Call `took_over`, then run `follow` as a task.

    """

    def __init__(
        self,
        trail: AuditTrail,
        audit: AuditLog,
        store: StateStore,
        signed: asyncio.Event,
        *,
        name: str,
        other: str,
    ) -> None:
        self._trail = trail
        self._audit = audit
        self._store = store
        self._signed = signed
        self._name = name
        self._other = other
        self._replicated = 0  # the number of the newest replicated checkpoint

    async def took_over(self, epoch: int) -> None:
        """Record the takeover, unless an earlier process did so in this epoch.

        The state gets the takeover once the record is on the disk.
        """
        own = await asyncio.to_thread(self._last_recorded)
        if own is None or own.epoch != epoch:
            state = await asyncio.to_thread(self._store.settings)
            checkpoint, reason = await asyncio.to_thread(self._others_checkpoint, state)
            named = _decode(state.get(_LAST_TAKEOVER, ""), EpochOf)
            previous = max((one for one in (own, named) if one is not None), key=_epoch, default=None)
            self._trail.happened(
                "took over",
                f"{self._name} is active from epoch {epoch}; {reason}",
                epoch=epoch,
                appliance=self._name,
                other=self._other,
                checkpoint=None if checkpoint is None else msgspec.to_builtins(checkpoint),
                previous=None if previous is None else msgspec.to_builtins(previous),
            )
        if await self._audit.wait_durable() is None:
            last = EpochOf(epoch, self._name)
            self._store.save_setting(_LAST_TAKEOVER, msgspec.json.encode(last).decode())

    async def handed_over(self, epoch: int) -> None:
        """Record the hand-over, and return when the state has the sealed log.

        If the hand-over fails, the event `switchover failed` revokes this record. The caller bounds the wait, because
        the signer may be slow or away.
        """
        self._trail.happened(
            "handed over",
            f"{self._name} handed over to {self._other} in epoch {epoch}",
            epoch=epoch,
            appliance=self._name,
            to=self._other,
        )
        await self._audit.wait_signed()
        await self._replicate()

    async def follow(self) -> None:
        await self._replicate()
        await self._audit.wait_signed()
        while True:
            await self._replicate()
            await self._signed.wait()
            self._signed.clear()
            await self._audit.wait_durable()  # the log has stored the signature before this

    async def _replicate(self) -> None:
        try:
            checkpoint = await asyncio.to_thread(newest_checkpoint, self._audit.path)
        except LogUnreadableError as error:
            _log.error("the checkpoint of the audit log is not replicated", reason=str(error))
            return
        if checkpoint is not None and checkpoint.number > self._replicated:
            self._replicated = checkpoint.number
            self._store.save_setting(_CHECKPOINT + self._name, checkpoint.as_json())

    def _last_recorded(self) -> EpochOf | None:
        try:
            found = search(self._audit.path, Filter(event=TOOK_OVER), None, 1).entries
        except LogUnreadableError:
            return None  # `AuditLog.failed` reports it
        try:
            detail = msgspec.convert(found[0].record.detail, TookOver) if found else None
        except msgspec.ValidationError:
            return None
        return None if detail is None else EpochOf(detail.epoch, detail.appliance)

    def _others_checkpoint(self, state: dict[str, str]) -> tuple[SignedCheckpoint | None, str]:
        stored = state.get(_CHECKPOINT + self._other)
        if not stored:
            return None, f"no checkpoint of {self._other} was replicated"
        found = _decode(stored, SignedCheckpoint)
        if found is None or found.fault() is not None:
            fault = "it is not a checkpoint" if found is None else "its signature is wrong"
            return None, f"the replicated checkpoint of {self._other} is not valid: {fault}"
        if found.key == self._own_key():
            return None, f"the replicated checkpoint of {self._other} is of this appliance's own log"
        return (
            found,
            f"the last replicated checkpoint of {self._other} is {found.number}, of record {found.sequence}",
        )

    def _own_key(self) -> str:
        pin = pinned_key_path(self._audit.path)
        try:
            return read_public_key(pin).hex() if pin.exists() else ""
        except KeyUnreadableError:
            return ""  # the log refuses signatures with this reason


def _epoch(takeover: EpochOf) -> int:
    return takeover.epoch


def _decode(text: str, kind: type[_T]) -> _T | None:
    try:
        return msgspec.json.decode(text, type=kind)
    except (ValueError, RecursionError):
        return None


_REPAIR_SECONDS = 8.0
_OVERDUE_SECONDS = 10.0  # with a processor that is shared a hundred times, calls still take a second or two


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
        overdue: Callable[[], float],
    ) -> None:
        self._settings, self._audit, self._keeps_state = settings, audit, keeps_state
        self._relays, self._probe, self._overdue = relays, probe, overdue
        self._sound = clock.now()  # when nothing was to be repaired

    def now(self) -> lease_link.ControlServes:
        failed, settings = self._audit.failed, self._settings
        # With less, hosts wait before the log fails: records still fit into SQLite's write-ahead file.
        obstacle = lacking_room(settings.state / "control")
        if failed is not None and settings.audit.on_audit_failure == "deny":
            obstacle = f"nothing is granted, because the audit log cannot be written: {failed}"
        if not obstacle and (overdue := self._overdue()) > _OVERDUE_SECONDS:
            obstacle = f"no call has been answered for {overdue:.0f} s"
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


async def begin(control: Control) -> ControlPart:
    role, store = control.role, control.store
    if not isinstance(role, PairedRole):
        return _part(StandbyOrders(None, control.trail))
    pair, replication, rollout = role.pair, role.replication, control.monitors.rollout
    recorder = await _begin_epoch(control, pair)
    copies = StateCopies(pair, store, rollout, replication.is_followed)

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
        await control.reconciler.ready.wait()
        monitors = control.monitors
        report = ServiceReport(
            control.settings,
            control.audit,
            lambda: holds_if_lost(monitors.checked.states, monitors.switches.is_enabled),
            relays=lambda: control.relay.presence,
            probe=lambda: control.lifeline.surroundings.probe,
            overdue=control.listener_limits.answering.overdue,
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


async def _begin_epoch(control: Control, pair: Pair) -> TakeoverRecorder:
    name, other = pair.membership.name, pair.membership.other
    recorder = TakeoverRecorder(
        control.trail, control.audit, control.store, control.signing.signed, name=name, other=other
    )
    await recorder.took_over(pair.epoch)
    control.monitors.rollout.inherit(*inherited_state(pair, control.store))
    return recorder
