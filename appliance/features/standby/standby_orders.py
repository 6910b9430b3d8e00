"""Answer operators about the two appliances, and order a planned switchover (docs/standby.md)."""

import asyncio
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, Protocol

import structlog

from appliance.channel import admin
from appliance.channel.admin import A
from appliance.channel.answers.standby_answers import StandbyState
from appliance.control.assembly.assembly import Parts
from appliance.control.assembly.foundation import Foundation
from appliance.control.errors import UnknownThingError
from appliance.control.service_report import ServiceReport
from appliance.features.standby.fleet_of_pair import compare_fleets
from appliance.features.standby.inheritance import StateCopies, inherited_state, keep_state, leave_state
from appliance.features.standby.lease_client import HandOverError
from appliance.features.standby.replication import Pair, Replication
from appliance.features.standby.takeover_record import TakeoverRecorder
from appliance.telemetry.audit_trail import AuditTrail

_log = structlog.get_logger()
_SEAL_SECONDS = 0.5  # the robot waits
_STANDBY = "the standby"
_SINGLE = "this appliance is not one of two; to add a standby, run `rosrv standby join` on both appliances"


class StandbySource(Protocol):
    """The state of the two appliances, and the switchover."""

    def state(self) -> StandbyState | None:
        """Return the state of both appliances; None: this appliance is not one of two."""

    async def hand_over(self) -> None:
        """Make the standby the active appliance. The active appliance may end before this returns.

        On the standby: ask the active appliance to hand over. Raises `HandOverError`.
        """


class SingleAppliance:
    """The `StandbySource` of an appliance that is not one of two."""

    def state(self) -> None:
        """Return None."""

    async def hand_over(self) -> None:
        """Raise `HandOverError`."""
        raise HandOverError(_SINGLE)


class ActiveAppliance:
    """The `StandbySource` of the active one of two.

    `leaving()` stops the relays and makes the last changes before the switchover. If it fails, `staying()` is called.
    """

    def __init__(
        self,
        replication: Replication,
        leaving: Callable[[], Awaitable[None]],
        staying: Callable[[], None],
    ) -> None:
        self._replication = replication
        self._leaving = leaving
        self._staying = staying

    def state(self) -> StandbyState:
        """Return the state of both appliances."""
        return self._replication.state()

    async def hand_over(self) -> None:
        """Make the standby the active appliance. Raises `HandOverError`."""
        await self._replication.require_ready()
        try:
            await self._leaving()
            await self._replication.hand_over()
        except HandOverError:
            self._staying()
            raise


async def begin_epoch(base: Foundation, parts: Parts) -> TakeoverRecorder | None:
    """Record that this appliance is active, and give its relays the state of the other one's monitors.

    Return None on a single appliance.
    """
    pair = base.pair
    if pair is None:
        return None
    name, other = pair.membership.name, pair.membership.other
    recorder = TakeoverRecorder(
        base.trail, base.audit, base.store, base.signing.signed, name=name, other=other
    )
    await recorder.took_over(pair.epoch)
    compare_fleets(base.settings.fleet, base.store, base.trail, name=name)
    parts.monitors.rollout.inherit(*inherited_state(pair, base.store))
    return recorder


def standby_source(base: Foundation, parts: Parts, recorder: TakeoverRecorder | None) -> StandbySource:
    """Return the source of an appliance in service; `recorder` records its hand-over."""
    pair, replication, rollout = base.pair, base.replication, parts.monitors.rollout
    if pair is None or replication is None or recorder is None:
        return SingleAppliance()

    async def leaving() -> None:
        await leave_state(pair, base.store, rollout)
        base.store.save_parameters(parts.core.parameters.tree)
        try:
            async with asyncio.timeout(_SEAL_SECONDS):
                await recorder.handed_over(pair.epoch)
        except TimeoutError:
            _log.warning("the log is not sealed before the switchover: the signer does not answer")

    return ActiveAppliance(replication, leaving, partial(keep_state, base.store, rollout))


def service_reports(base: Foundation, parts: Parts, pair: Pair) -> Callable[[], Awaitable[None]]:
    """Return the reports to the lease, of an appliance that serves from now on."""
    return partial(pair.lease.report_service, ServiceReport(base, parts).now)


def state_copies(pair: Pair, replication: Replication, base: Foundation, parts: Parts) -> StateCopies:
    """Return the copies of the state of monitors for the standby."""
    return StateCopies(pair, base.store, parts.monitors.rollout, replication.followed)


class StandbyOrders:
    """The answers of an appliance in service. Its methods raise `UnknownThingError` on a single appliance."""

    def __init__(self, source: StandbySource, trail: AuditTrail) -> None:
        self._source = source
        self._trail = trail

    async def state(self, _request: admin.StandbyWanted) -> StandbyState:
        """Return the state of both appliances."""
        return _state_of(self._source)

    async def promote(self, _request: admin.StandbyPromote, who: str) -> StandbyState:
        """Make the standby the active appliance. Raises `HandOverError`.

        The order is on disk before the hand-over begins, because the hand-over ends this process.
        """
        other = _state_of(self._source).other
        self._trail.happened(
            "switchover ordered", f"{other.name} ({other.address}) is to become the active appliance", who=who
        )
        await self._trail.durable()
        try:
            await self._source.hand_over()
        except HandOverError as error:
            self._trail.happened("switchover failed", str(error), who=who)
            await self._trail.durable()
            raise
        return _state_of(self._source)

    async def obey(self, wanted: asyncio.Event, refuse: Callable[[str], Awaitable[None]]) -> None:
        """Carry out the orders that operators give on the standby, until cancelled; `refuse(reason)` answers it."""
        while True:
            await wanted.wait()
            wanted.clear()
            try:
                await self.promote(admin.StandbyPromote(), _STANDBY)
            except HandOverError as error:
                await refuse(str(error))


class StandbyAdministration:
    """The answers of a standby: its state and, if `orders`, the switchover. All other requests are rejected.

    `orders` is for the admin socket only: over REST, the order is given to the active appliance, which records it.
    """

    def __init__(self, source: StandbySource, *, orders: bool) -> None:
        self._source = source
        self._answers: dict[type, Callable[[], Awaitable[StandbyState]]] = {admin.StandbyWanted: self._state}
        if orders:
            self._answers[admin.StandbyPromote] = self._promoted

    async def carry_out(self, request: admin.AdminRequest[A], *, who: str) -> admin.AdminAnswer[A]:
        """Answer a request, whose sender does not matter."""
        del who
        answer: Callable[[], Awaitable[Any]] | None = self._answers.get(type(request))
        if answer is None:
            return on_standby(_state_of(self._source))
        try:
            return admin.AdminAnswer(True, await answer())
        except HandOverError as error:
            return admin.AdminAnswer(False, error=str(error), trouble="failed")

    async def _state(self) -> StandbyState:
        return _state_of(self._source)

    async def _promoted(self) -> StandbyState:
        await self._source.hand_over()
        return _state_of(self._source)


def on_standby(state: StandbyState) -> admin.AdminAnswer[Any]:
    """Return the answer of a standby to a request that only the active appliance can carry out."""
    other = state.other
    text = f"this appliance is the standby of {other.name} ({other.address}); give the command there"
    return admin.AdminAnswer(False, error=text, trouble="standby", active=other.address)


def _state_of(source: StandbySource) -> StandbyState:
    state = source.state()
    if state is None:
        raise UnknownThingError(_SINGLE)
    return state
