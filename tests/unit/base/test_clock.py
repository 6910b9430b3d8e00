import asyncio
import contextvars
import time
from datetime import UTC, datetime

import pytest

from appliance.base import clock
from tests.support.virtual_clock import ShiftedClock, VirtualClock


def test_the_default_clocks_are_those_of_the_operating_system(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(time, "clock_gettime_ns", asked.append)
    source = contextvars.Context().run(clock.source)
    assert source.now_ns.__name__ == "monotonic_ns"
    assert source.wall_ns.__name__ == "time_ns"
    source.since_boot_ns()
    assert asked == [time.CLOCK_BOOTTIME]


def test_a_replaced_clock_ends_with_its_block() -> None:
    outer, inner = VirtualClock(now=1.0), VirtualClock(now=2.0)
    with clock.using(outer):
        try:
            with clock.using(inner):
                assert clock.now() == 2.0
                raise KeyError
        except KeyError:
            assert clock.now() == 1.0
    assert clock.now() > 2.0


@pytest.mark.anyio
async def test_a_task_keeps_the_clock_of_its_creator() -> None:
    read: list[float] = []

    async def machine(now: float) -> None:
        with clock.using(VirtualClock(now=now)):
            asyncio.get_running_loop().call_later(0.0, lambda: read.append(clock.now()))
            await asyncio.create_task(asyncio.sleep(0.0))
        while read.count(now) == 0:
            await asyncio.sleep(0.0)

    await asyncio.gather(machine(1.0), machine(2.0))
    assert sorted(read) == [1.0, 2.0]


def test_a_virtual_clock_moves_only_by_hand() -> None:
    machine = VirtualClock(wall=5000, now=10)
    with clock.using(machine):
        machine.advance(1.5)
        assert (clock.now(), clock.wall(), clock.since_boot()) == (11.5, 5001.5, 11.5)
        machine.sleep(2)
        machine.set_wall(60)
        assert (clock.now_ns(), clock.wall_ns(), clock.since_boot_ns()) == (
            11_500_000_000,
            60 * 10**9,
            13_500_000_000,
        )
        assert clock.utc_now() == datetime(1970, 1, 1, 0, 1, tzinfo=UTC)


def test_a_shifted_clock_goes_on() -> None:
    machine = VirtualClock(wall=5000, now=10)
    with clock.using(machine), clock.using(ShiftedClock(3600)):
        machine.advance(1)
        assert (clock.now(), clock.wall(), clock.since_boot()) == (11, 8601, 11)
