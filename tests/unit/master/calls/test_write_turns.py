"""Writes of one key, of what is above and of what is below it wait for each other; others do not."""

import asyncio
from collections.abc import Sequence

import pytest

from appliance.master.calls.call_order import WriteTurns


async def write(turns: WriteTurns, keys: Sequence[str], order: list[str], go: asyncio.Event) -> None:
    """One write, which takes until `go`."""
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
def test_those_that_touch_wait(first: list[str], second: list[str], waits: bool) -> None:
    """The second is let in only after the first is out if a key of one is, or is above, a key of the other."""

    async def scene() -> None:
        turns, inside, go = WriteTurns(), asyncio.Event(), asyncio.Event()

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

    asyncio.run(scene())


def test_first_come_first_served() -> None:
    """A write of the whole tree waits for those before it, and those after it for it: nobody overtakes."""

    async def scene() -> None:
        turns, order, go = WriteTurns(), list[str](), asyncio.Event()
        tasks = [asyncio.create_task(write(turns, [key], order, go)) for key in ("/a", "/", "/b")]
        for _ in range(5):
            await asyncio.sleep(0)
        assert order == ["/a in"]
        go.set()
        await asyncio.gather(*tasks)
        assert order == ["/a in", "/a out", "/ in", "/ out", "/b in", "/b out"]

    asyncio.run(scene())


def test_who_stops_waiting_holds_up_nobody() -> None:
    """A cancelled wait and a failed write leave nothing behind, and let nobody in too early."""

    async def scene() -> None:
        turns, order, go, at_once = WriteTurns(), list[str](), asyncio.Event(), asyncio.Event()
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

    asyncio.run(scene())
