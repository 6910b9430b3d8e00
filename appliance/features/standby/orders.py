"""Answer operators about the two appliances, and order a planned switchover (docs/standby.md)."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, Never, Protocol

import structlog

from appliance.base.withdrawal import WithdrawnError, take_effect
from appliance.channel import admin
from appliance.channel.admin import A
from appliance.control.errors import UnknownThingError
from appliance.features.standby import requests as standby_requests
from appliance.features.standby.answers import StandbyState
from appliance.features.standby.lease_client import HandOverError
from appliance.features.standby.replication import Replication
from appliance.telemetry.audit_trail import AuditTrail

_log = structlog.get_logger()
_STANDBY = "the standby"
_SINGLE = "this appliance is not one of two; to add a standby, run `rosrv standby join` on both appliances"


class StandbySource(Protocol):
    """The state of the two appliances, and the switchover."""

    def state(self) -> StandbyState: ...

    async def hand_over(self) -> None:
        """Raise `HandOverError`. The active appliance may end before this returns."""


class ActiveAppliance:
    """The `StandbySource` of the active appliance."""

    def __init__(
        self,
        replication: Replication,
        rehearsing: Callable[[], Awaitable[None]],  # writes as much as `leaving`, and pauses nothing
        leaving: Callable[[], Awaitable[None]],  # makes the last changes before the switchover
        staying: Callable[[], None],  # called if the switchover fails
    ) -> None:
        self._replication = replication
        self._rehearsing = rehearsing
        self._leaving = leaving
        self._staying = staying

    def state(self) -> StandbyState:
        return self._replication.state()

    async def hand_over(self) -> None:
        await self._replication.require_ready(self._rehearsing)
        take_effect()
        try:
            await self._leaving()
            await self._replication.hand_over()
        except HandOverError:
            self._staying()
            raise


class StandbyOrders:
    """Answers operators of an appliance in service. Requests raise `UnknownThingError` without a pair."""

    def __init__(self, source: StandbySource | None, trail: AuditTrail) -> None:
        self._source = source
        self._trail = trail

    async def state(self, _request: standby_requests.StandbyWanted) -> StandbyState:
        return self._pair().state()

    async def promote(self, _request: standby_requests.StandbyPromote, who: str) -> StandbyState:
        """Hand over to the standby. The order is on the disk before, because the hand-over ends this process."""
        pair = self._pair()
        other = pair.state().other
        self._trail.happened(
            "switchover ordered", f"{other.name} ({other.address}) is to become the active appliance", who=who
        )
        await self._trail.durable()
        try:
            await pair.hand_over()
        except (HandOverError, WithdrawnError) as error:
            self._trail.happened("switchover failed", str(error), who=who)
            await self._trail.durable()
            raise
        return pair.state()

    async def obey(self, wanted: asyncio.Event, refuse: Callable[[str], Awaitable[None]]) -> None:
        while True:
            await wanted.wait()
            wanted.clear()
            try:
                await self.promote(standby_requests.StandbyPromote(), _STANDBY)
            except HandOverError as error:
                await refuse(str(error))

    def _pair(self) -> StandbySource:
        if self._source is None:
            raise UnknownThingError(_SINGLE)
        return self._source


class StandbyAdministration:
    """The answers of a standby: its state and, if `orders`, the switchover.

    Over REST, the active appliance gets the order, and records it.
    """

    def __init__(self, source: StandbySource, *, orders: bool) -> None:
        self._source = source
        self._orders = orders

    async def carry_out(self, request: admin.AdminRequest[A], *, who: str) -> admin.AdminAnswer[A]:
        del who
        promotes = self._orders and isinstance(request, standby_requests.StandbyPromote)
        if not promotes and not isinstance(request, standby_requests.StandbyWanted):
            return on_standby(self._source.state())
        try:
            if promotes:
                await self._source.hand_over()
        except HandOverError as error:
            return admin.AdminAnswer(False, error=str(error), trouble="failed")
        state: Any = self._source.state()
        return admin.AdminAnswer(True, state)


def on_standby(state: StandbyState) -> admin.AdminAnswer[Never]:
    other = state.other
    text = f"this appliance is the standby of {other.name} ({other.address}); give the command there"
    return admin.AdminAnswer(False, error=text, trouble="standby", active=other.address)
