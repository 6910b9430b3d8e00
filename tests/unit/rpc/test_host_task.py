import asyncio
import ipaddress
from functools import partial

import pytest

from appliance.rpc.processor_time import TURN_SECONDS, HostTask, ProcessorTime

pytestmark = pytest.mark.anyio

ROBOT, GUEST = ipaddress.ip_address("10.0.0.1"), ipaddress.ip_address("10.0.0.66")


@pytest.fixture
def time() -> ProcessorTime:
    return ProcessorTime(lambda host: host, lambda: 0.0)


async def test_work_that_waits_for_nothing_ends_at_once(time: ProcessorTime) -> None:
    async def work() -> str:
        return "done"

    assert HostTask(time, ROBOT, work()).result() == "done"
    time.charge(GUEST, TURN_SECONDS)
    made: list[HostTask[str]] = []
    time.run(GUEST, lambda: made.append(HostTask(time, GUEST, work())))
    time.run(ROBOT, lambda: None)
    waiting = HostTask(time, ROBOT, work())
    assert not made
    assert not waiting.done()
    assert await waiting == "done"
    assert made[0].result() == "done"


async def test_a_task_is_the_current_one_in_its_steps(time: ProcessorTime) -> None:
    seen: list[object] = []

    async def inner() -> None:
        seen.append(asyncio.current_task())
        await asyncio.sleep(0)
        seen.append(asyncio.current_task())

    async def outer() -> None:
        made.append(HostTask(time, ROBOT, inner()))
        seen.append(asyncio.current_task())
        await made[0]

    made: list[HostTask[None]] = []
    task = HostTask(time, ROBOT, outer())
    assert id(task) in map(id, asyncio.all_tasks())
    await task
    assert seen == [made[0], task, made[0]]
    assert id(task) not in map(id, asyncio.all_tasks())


async def test_a_limit_of_time_ends_a_wait(time: ProcessorTime) -> None:
    async def work() -> str:
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.001):
                await asyncio.Event().wait()
        await asyncio.sleep(0)
        return "went on"

    assert await HostTask(time, ROBOT, work()) == "went on"


@pytest.mark.parametrize("busy", [False, True], ids=["waiting", "its step is due"])
async def test_a_cancelled_task_ends(busy: bool, time: ProcessorTime) -> None:
    ready, ended = asyncio.Event(), list[str]()

    async def work() -> None:
        try:
            await ready.wait()
            ended.append("ran")
        except asyncio.CancelledError:
            ended.append("cancelled")
            raise

    task = HostTask(time, ROBOT, work())
    await asyncio.sleep(0)  # the next turn begins
    if busy:
        ready.set()
        asyncio.get_running_loop().call_soon(task.cancel)
        time.charge(GUEST, TURN_SECONDS)
    else:
        assert task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert (ended, task.cancelled(), task.cancel()) == (["cancelled"], True, False)


async def test_a_task_may_refuse_a_cancellation(time: ProcessorTime) -> None:
    async def refuses() -> str:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            return "went on"
        return ""

    async def cancels_itself() -> None:
        asyncio.get_running_loop().call_soon(ended.append, "loop ran")
        current = asyncio.current_task()
        assert current is not None
        current.cancel()
        await asyncio.Event().wait()

    ended: list[str] = []
    task = HostTask(time, ROBOT, refuses())
    task.cancel()
    assert await task == "went on"
    with pytest.raises(asyncio.CancelledError):
        await HostTask(time, ROBOT, cancels_itself())
    assert ended == ["loop ran"]


async def test_an_error_reaches_the_owner(time: ProcessorTime) -> None:
    async def work(steps: int) -> None:
        for _ in range(steps):
            await asyncio.sleep(0)
        raise ValueError(steps)

    for steps in (0, 2):
        with pytest.raises(ValueError, match=str(steps)):
            await HostTask(time, ROBOT, work(steps))
    order: list[int] = []
    assert time.run(ROBOT, partial(order.append, 1)) or time.waiting
