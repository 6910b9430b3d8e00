"""Tests of `appliance.api.history`."""

import asyncio
import contextlib
from typing import Any

from appliance.api import history
from appliance.api.control import ControlAwayError
from appliance.api.history import History, sample_of
from appliance.channel.answers.measures import Measures
from tests.support.answers import example


def body(allowed: int = 0) -> Measures:
    """Control's measures, as far as they are read."""
    return example(
        Measures,
        status={"version": "1"},
        decisions=[("publish", "allow", allowed), ("publish", "deny", 2), ("command", "would deny", 3)],
        relayed={"/a": [5, 50, 1], "/b": [7, 70, 0]},
        monitors=[("verdict", "watch", 4), ("drop", "watch", 1), ("log", "watch", 9)],
        nodes={"live": 3, "lost": 1},
    )


def test_a_sample_adds_up() -> None:
    """Decisions over all categories, messages over all topics, what monitors did by name; output is not counted."""
    sample = sample_of(body(11), 100.0)
    assert (sample.time, sample.allowed, sample.denied) == (100.0, 11, 5)
    assert (sample.messages, sample.bytes, sample.dropped, sample.nodes) == (12, 120, 1, 3)
    assert sample.monitors == {"watch": [4, 1, 0, 0]}


async def _running(history: History, until: int) -> None:
    task = asyncio.create_task(history.run())
    with history.following():
        async with asyncio.timeout(20):
            while history.seen.number < until:
                await history.after(history.seen.number)
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


def test_followers_are_told_and_the_hour_is_kept(monkeypatch: Any) -> None:
    """Each answer is a sample, in order; `samples` gives at most so many, the newest always among them."""
    monkeypatch.setattr(history, "BUSY_SECONDS", 0.001)
    count = 0

    async def measures() -> Measures:
        nonlocal count
        count += 1
        return body(count)

    async def scenario() -> None:
        history = History(measures)
        await _running(history, 25)
        everything = history.samples(1000)
        assert [one.allowed for one in everything] == list(range(1, len(everything) + 1))
        few = history.samples(6)
        assert len(few) <= 6
        assert few[-1] == everything[-1]

    asyncio.run(scenario())


def test_samples_grow_in_time_when_the_clock_is_set_back(monkeypatch: Any) -> None:
    """Those of the time that comes again are gone: rates and curves would run backwards."""
    monkeypatch.setattr(history, "BUSY_SECONDS", 0.001)
    times = [1000.0, 1010.0, 8200.0, 1005.0, 1015.0]
    clock = iter(times)
    monkeypatch.setattr("time.time", lambda: next(clock, 1020.0))

    async def measures() -> Measures:
        return body()

    async def scenario() -> list[float]:
        history = History(measures)
        await _running(history, len(times))
        return [one.time for one in history.samples(1000) if one.time != 1020.0]

    assert asyncio.run(scenario()) == [1005.0, 1015.0]


def test_without_control_followers_are_told_why(monkeypatch: Any) -> None:
    """While RVMaster is away there is no sample and no status, but the reason; then it goes on."""
    monkeypatch.setattr(history, "BUSY_SECONDS", 0.001)
    answers: list[ControlAwayError | Measures] = [ControlAwayError("being restarted"), body(1)]

    async def measures() -> Measures:
        answer = answers.pop(0) if len(answers) > 1 else answers[0]
        if isinstance(answer, ControlAwayError):
            raise answer
        return answer

    async def scenario() -> None:
        history = History(measures)
        task = asyncio.create_task(history.run())
        with history.following():
            async with asyncio.timeout(20):
                first = await history.after(0)
                assert (first.status, first.sample, first.away) == (None, None, "being restarted")
                second = await history.after(first.number)
                assert second.away is None
                assert second.status is not None
                assert second.status.version == "1"
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task

    asyncio.run(scenario())


def test_who_begins_to_follow_does_not_wait(monkeypatch: Any) -> None:
    """A sleep that was begun while nobody followed ends when somebody does."""
    monkeypatch.setattr(history, "IDLE_SECONDS", 3600.0)

    async def measures() -> Measures:
        return body()

    async def scenario() -> None:
        history = History(measures)
        task = asyncio.create_task(history.run())
        async with asyncio.timeout(20):
            seen = await history.after(0)
            with history.following():
                assert (await history.after(seen.number)).number > seen.number
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task

    asyncio.run(scenario())
