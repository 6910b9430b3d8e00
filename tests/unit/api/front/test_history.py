import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable

import pytest

from appliance.api.front.control import ControlAwayError
from appliance.api.front.history import SampleHistory, sample_of
from appliance.base.clock import using
from appliance.channel.answers.measures import Measures
from tests.support.answers import example
from tests.support.virtual_clock import VirtualClock

pytestmark = pytest.mark.anyio


def body(allowed: int = 0) -> Measures:
    return example(
        Measures,
        status={"version": "1"},
        decisions=[("publish", "allow", allowed), ("publish", "deny", 2), ("command", "would deny", 3)],
        relayed={"/a": [5, 50, 1], "/b": [7, 70, 0]},
        monitors=[("verdict", "watch", 4), ("drop", "watch", 1), ("log", "watch", 9)],
        nodes={"live": 3, "lost": 1},
    )


def test_a_sample_adds_up() -> None:
    sample = sample_of(body(11), 100.0)
    assert (sample.time, sample.allowed, sample.denied) == (100.0, 11, 5)
    assert (sample.messages, sample.bytes, sample.dropped, sample.nodes) == (12, 120, 1, 3)
    assert sample.monitors == {"watch": [4, 1, 0, 0]}


@contextlib.asynccontextmanager
async def sampling(measures: Callable[[], Awaitable[Measures]]) -> AsyncIterator[SampleHistory]:
    samples = SampleHistory(measures)
    task = asyncio.create_task(samples.run())
    yield samples
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


async def until(samples: SampleHistory, number: int) -> None:
    with samples.following():
        while samples.seen.number < number:
            await samples.after(samples.seen.number)


async def unchanging() -> Measures:
    return body()


async def test_followers_get_each_sample_and_an_hour_is_stored() -> None:
    count = 0

    async def measures() -> Measures:
        nonlocal count
        count += 1
        return body(count)

    async with sampling(measures) as samples:
        await until(samples, 25)
    everything, few = samples.samples(1000), samples.samples(6)
    assert [one.allowed for one in everything] == list(range(1, len(everything) + 1))
    assert len(few) <= 6
    assert few[-1] == everything[-1]


async def test_samples_stay_in_order_when_the_clock_is_set_back() -> None:
    times = [1000.0, 1010.0, 8200.0, 1005.0, 1015.0]
    machine, later = VirtualClock(), iter(times)

    async def measures() -> Measures:
        machine.set_wall(next(later, 1020.0))
        return body()

    with using(machine):
        async with sampling(measures) as samples:
            await until(samples, len(times))
    assert [sample.time for sample in samples.samples(1000) if sample.time != 1020.0] == [1005.0, 1015.0]


async def test_without_control_followers_get_the_reason() -> None:
    answers: list[ControlAwayError | Measures] = [ControlAwayError("being restarted"), body(1)]

    async def measures() -> Measures:
        answer = answers.pop(0) if len(answers) > 1 else answers[0]
        if isinstance(answer, ControlAwayError):
            raise answer
        return answer

    async with sampling(measures) as samples:
        with samples.following():
            first = await samples.after(0)
            assert (first.status, first.sample, first.away) == (None, None, "being restarted")
            second = await samples.after(first.number)
            assert second.away is None
            assert second.status is not None
            assert second.status.version == "1"


async def test_a_new_follower_does_not_wait() -> None:
    async with sampling(unchanging) as samples:
        seen = await samples.after(0)
        with samples.following():
            assert (await samples.after(seen.number)).number > seen.number
