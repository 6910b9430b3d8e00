import asyncio

import pytest

from appliance.base import clock
from appliance.features.standby.pairing import LeaseWatch
from appliance.supervisor.service_gate import RoleChanges
from tests.support.virtual_clock import VirtualClock

pytestmark = pytest.mark.anyio


class Role:
    def __init__(self) -> None:
        self.orders: list[int | str] = []
        self.stopped = asyncio.Event()
        self.serving = True  # False: a process is only starting
        changes = RoleChanges(
            self.orders.append,
            lambda: self._stop("passive"),
            self._suspend,
            lambda: self.orders.append("resumed"),
        )
        self.watch = LeaseWatch(changes)

    def _stop(self, order: str) -> None:
        self.orders.append(order)
        self.stopped.set()

    def _suspend(self) -> bool:
        if self.serving:
            self._stop("suspended")
        return self.serving

    async def until_stopped(self) -> float:
        await self.stopped.wait()
        return clock.since_boot()


@pytest.fixture
async def role() -> Role:
    return Role()


async def test_it_is_passive_until_the_lease_is_held(role: Role) -> None:
    assert role.orders == []
    role.watch.held(clock.since_boot() + 60, 5)
    assert role.orders == [5]
    assert role.watch.active


async def test_it_stops_when_no_further_report_arrives(role: Role) -> None:
    until = clock.since_boot() + 0.2
    role.watch.held(until, 5)
    assert await role.until_stopped() >= until
    assert role.orders == [5, "suspended"]
    assert not role.watch.active


async def test_a_later_report_extends_the_time(role: Role) -> None:
    role.watch.held(clock.since_boot() + 0.05, 5)
    until = clock.since_boot() + 0.3
    role.watch.held(until, 5)
    assert await role.until_stopped() >= until
    assert role.orders == [5, "suspended"]


async def test_a_renewal_in_the_same_epoch_ends_a_lapse(role: Role) -> None:
    role.watch.held(clock.since_boot() + 0.05, 5)
    for _ in range(2):
        await role.until_stopped()
        role.stopped.clear()
        role.watch.lapsed()  # the report of the same lapse
        role.watch.held(clock.since_boot() - 0.001, 5)  # late
        assert not role.watch.active
        role.watch.held(clock.since_boot() + 0.05, 5)
        assert role.watch.active
    assert role.orders == [5, *["suspended", "resumed"] * 2]


async def test_a_boot_of_the_robot_ends_nothing(role: Role) -> None:
    """While the standby is off, no other appliance can be active, and the state in memory stays the newest."""
    role.watch.held(clock.since_boot() + 0.05, 5)
    await role.until_stopped()
    await asyncio.sleep(120.0)
    role.watch.held(clock.since_boot() + 0.05, 5)
    assert role.orders == [5, "suspended", "resumed"]


@pytest.mark.parametrize("end", ["ended", "not_renewable", "later epoch", "time"])
async def test_a_lapse_that_no_renewal_ends(role: Role, end: str) -> None:
    role.watch.held(clock.since_boot() + 60, 5)
    role.watch.lapsed()
    role.stopped.clear()
    if end == "later epoch":
        role.watch.held(clock.since_boot() + 60, 7)
    elif end != "time":
        getattr(role.watch, end)()
    await role.until_stopped()
    assert role.orders == [5, "suspended", "passive", *([7] if end == "later epoch" else [])]


@pytest.mark.parametrize("reason", ["starting", "not renewable"])
async def test_a_lapse_that_cannot_be_suspended_ends_the_service(role: Role, reason: str) -> None:
    """A process that is still starting would begin to serve; a new lease process gets a new epoch."""
    role.watch.held(clock.since_boot() + 0.05, 5)
    role.serving = reason != "starting"
    if reason == "not renewable":
        role.watch.not_renewable()
    await role.until_stopped()
    assert role.orders == [5, "passive"]


async def test_a_report_that_arrives_too_late_does_not_activate(role: Role) -> None:
    role.watch.held(clock.since_boot() - 0.001, 5)
    assert role.orders == [] and not role.watch.active


async def test_a_late_report_of_an_active_appliance_stops_it_at_once(role: Role) -> None:
    role.watch.held(clock.since_boot() + 60, 5)
    role.watch.held(clock.since_boot() - 0.001, 5)
    assert role.orders == [5, "suspended"]


async def test_a_new_epoch_ends_the_state_of_the_old_one(role: Role) -> None:
    role.watch.held(clock.since_boot() + 60, 5)
    role.watch.held(clock.since_boot() + 60, 7)
    assert role.orders == [5, "passive", 7]


async def test_the_end_of_the_lease_is_reported_once(role: Role) -> None:
    role.watch.held(clock.since_boot() + 60, 5)
    role.watch.ended()
    role.watch.ended()
    assert role.orders == [5, "passive"]


async def test_the_time_counts_while_the_machine_sleeps(role: Role) -> None:
    """The timer of the loop stops with the machine, so it is set again by the clock that does not."""
    machine = VirtualClock()
    with clock.using(machine):
        role.watch.held(clock.since_boot() + 0.05, 5)
        machine.sleep(3600.0)
        await role.until_stopped()
