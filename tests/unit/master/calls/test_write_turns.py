import asyncio
from collections.abc import Sequence

import pytest

from appliance.master.calls.call_execution import KeyTurns

pytestmark = pytest.mark.anyio


async def write(turns: KeyTurns, keys: Sequence[str], order: list[str], go: asyncio.Event) -> None:
    async with turns.alone(keys):
        order.append(f"{keys[0]} in")
        await go.wait()
        order.append(f"{keys[0]} out")


@pytest.mark.parametrize(
    ("first", "second", "waits"),
    [
        (["/a"], ["/a"], True),
        (["/a"], ["/a/b"], True),
        (["/a/b/c"], ["/a"], True),
        (["/"], ["/a"], True),
        (["/a"], ["/"], True),
        (["/x", "/a/b"], ["/y", "/a"], True),
        (["/a"], ["/ab"], False),
        (["/a/b"], ["/a/c"], False),
        ([], ["/"], False),
    ],
)
async def test_overlapping_writes_wait(first: list[str], second: list[str], waits: bool) -> None:
    turns, inside, go = KeyTurns(), asyncio.Event(), asyncio.Event()

    async def before() -> None:
        async with turns.alone(first):
            await go.wait()

    async def after() -> None:
        async with turns.alone(second):
            inside.set()

    tasks = [asyncio.create_task(before()), asyncio.create_task(after())]
    for _ in range(5):
        await asyncio.sleep(0)
    assert inside.is_set() is not waits
    go.set()
    await asyncio.gather(*tasks)
    assert inside.is_set()
    assert len(turns) == 0


async def test_first_come_first_served() -> None:
    turns, order, go = KeyTurns(), list[str](), asyncio.Event()
    tasks = [asyncio.create_task(write(turns, [key], order, go)) for key in ("/a", "/", "/b")]
    for _ in range(5):
        await asyncio.sleep(0)
    assert order == ["/a in"]
    go.set()
    await asyncio.gather(*tasks)
    assert order == ["/a in", "/a out", "/ in", "/ out", "/b in", "/b out"]


async def test_a_cancelled_write_delays_no_other() -> None:
    turns, order, go, at_once = KeyTurns(), list[str](), asyncio.Event(), asyncio.Event()
    at_once.set()
    first = asyncio.create_task(write(turns, ["/a"], order, go))
    waiting = asyncio.create_task(write(turns, ["/a/b"], order, at_once))
    last = asyncio.create_task(write(turns, ["/a/b/c"], order, at_once))
    await asyncio.sleep(0)
    waiting.cancel()
    for _ in range(5):
        await asyncio.sleep(0)
    assert order == ["/a in"]
    first.cancel()
    await asyncio.gather(first, waiting, last, return_exceptions=True)
    assert order == ["/a in", "/a/b/c in", "/a/b/c out"]
    assert len(turns) == 0


async def test_registering_calls_of_a_name_are_served_in_order_of_arrival() -> None:
    names, order = KeyTurns(), list[str]()
    first, at_once = asyncio.Event(), asyncio.Event()
    at_once.set()

    async def register(name: str, mark: str, go: asyncio.Event) -> None:
        async with names.of_name(name) as later:
            order.append(f"{mark} in{' later' if later else ''}")
            await go.wait()
            order.append(f"{mark} out")
            if mark == "failing":
                raise ValueError

    calls = [
        ("/a", "first", first),
        ("/a", "failing", at_once),
        ("/a", "last", at_once),
        ("/a/b", "other", at_once),
    ]
    tasks = [asyncio.create_task(register(*call)) for call in calls]
    await tasks[3]
    assert order == ["first in", "other in", "other out"]
    first.set()
    await asyncio.gather(*tasks, return_exceptions=True)
    assert order[3:] == ["first out", "failing in later", "failing out", "last in later", "last out"]
    assert len(names) == 0
