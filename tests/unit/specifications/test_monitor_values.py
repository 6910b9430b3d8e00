"""Readers of a monitor's variables share answers, and get the last one with its age while a relay is away."""

import asyncio
import functools
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from appliance.base import clock
from appliance.channel.messages import Message, ValuesSeen, ValuesWanted
from appliance.specifications.monitor_values import (
    ANSWER_SECONDS,
    FRESH_SECONDS,
    ONE_LOOK,
    MonitorValues,
)
from tests.support import autojump
from tests.support.core import FakeTrail


def virtual(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Run a test in virtual time."""

    @functools.wraps(test)
    def run(*fixtures: Any, **named: Any) -> None:
        autojump.run(test(*fixtures, **named))

    return run


class Desk:
    """The variables of monitors, and a relay that answers queries at once unless it is `silent` or `away`."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.silent = self.away = False
        self.x, self.trail, self.revision = 1.0, FakeTrail(), 1
        self.relay = 1
        self.values = MonitorValues(
            self._send, lambda _monitor: self.relay, lambda: self.revision, self.trail
        )

    def _send(self, message: Message, relay: int) -> bool:
        assert isinstance(message, ValuesWanted)
        if self.away:
            return False
        self.asked.append(message.monitor)
        if not self.silent:
            answer = ValuesSeen(message.number, {"x": self.x}, {"pose": 0.5, "foreign": None}, 7_000_000_000)
            asyncio.get_running_loop().call_later(0.01, self.values.received, answer, relay)
        return True


@pytest.fixture
def desk() -> Desk:
    return Desk()


@virtual
async def test_readers_share_an_answer_for_a_quarter_of_a_second(desk: Desk) -> None:
    found = await asyncio.gather(*(desk.values.of("fence", f"reader {number}") for number in range(20)))
    assert {one.values["x"] for one in found} == {1.0}
    await desk.values.of("fence", "another")
    assert desk.asked == ["fence"]
    desk.x = 2.0
    await asyncio.sleep(FRESH_SECONDS + 0.01)
    assert (await desk.values.of("fence", "another")).values == {"x": 2.0}


@pytest.mark.parametrize("how", ["away", "silent"])
@virtual
async def test_without_the_relay_the_last_answer_is_shown_with_its_age(desk: Desk, how: str) -> None:
    await desk.values.of("fence", "ann")
    setattr(desk, how, True)
    await asyncio.sleep(5)
    found = await desk.values.of("fence", "ann")
    assert found.values == {"x": 1.0}
    assert found.age_seconds == pytest.approx(5, abs=ANSWER_SECONDS + 0.1)
    assert found.age_seconds is not None
    assert found.ages == {"pose": pytest.approx(found.age_seconds + 0.5), "foreign": None}
    assert found.now_seconds == pytest.approx(found.age_seconds + 7)
    assert "relay process" in found.why_old
    setattr(desk, how, False)
    assert (await desk.values.of("fence", "ann")).why_old == ""


@virtual
async def test_before_the_first_answer_there_are_no_values(desk: Desk) -> None:
    desk.away = True
    found = await desk.values.of("fence", "ann")
    assert (found.values, found.age_seconds, bool(found.why_old)) == ({}, None, True)


@virtual
async def test_a_relay_that_ends_answers_its_readers_at_once(desk: Desk) -> None:
    desk.silent = True
    waiting = asyncio.ensure_future(desk.values.of("fence", "ann"))
    await asyncio.sleep(0.1)
    began = clock.now()
    desk.values.relay_lost(0)
    await asyncio.sleep(0)
    assert not waiting.done()
    desk.values.relay_lost(1)
    assert (await waiting).age_seconds is None
    assert clock.now() == began


@virtual
async def test_values_of_an_earlier_revision_are_not_shown(desk: Desk) -> None:
    await desk.values.of("fence", "ann")
    desk.revision, desk.away = 2, True
    assert (await desk.values.of("fence", "ann")).values == {}


@virtual
async def test_a_late_answer_is_discarded(desk: Desk) -> None:
    desk.silent = True
    await desk.values.of("fence", "ann")
    desk.values.received(ValuesSeen(1, {"x": 9.0}), 1)
    desk.away = True
    assert (await desk.values.of("fence", "ann")).values == {}


@virtual
async def test_only_the_relay_that_was_asked_answers(desk: Desk) -> None:
    desk.silent, number = True, clock.now_ns() + 1
    waiting = asyncio.ensure_future(desk.values.of("fence", "ann"))
    await asyncio.sleep(0)
    desk.relay = 0  # the monitor moves
    desk.values.received(ValuesSeen(number, {"x": 9.0}), 0)
    await asyncio.sleep(0.1)
    assert not waiting.done()
    desk.values.received(ValuesSeen(number, {"x": 1.0}), 1)
    assert (await waiting).values == {"x": 1.0}


@virtual
async def test_a_look_is_one_record_however_long_it_lasts(desk: Desk) -> None:
    for _ in range(200):
        await desk.values.of("fence", "ann")
        await asyncio.sleep(1)
    await desk.values.of("fence", "bob")
    await asyncio.sleep(ONE_LOOK)
    await desk.values.of("fence", "ann")
    looks = [
        (row["who"], row["resource"]) for row in desk.trail.rows if row["event"] == "monitor looked into"
    ]
    assert looks == [("ann", "fence"), ("bob", "fence"), ("ann", "fence")]
