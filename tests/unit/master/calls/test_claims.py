"""Registering calls under one name wait for each other; calls under other names, even names below it, do not."""

import asyncio

import pytest

from appliance.master.calls.call_order import KeyTurns

pytestmark = pytest.mark.anyio


async def test_one_after_the_other_by_name() -> None:
    order: list[str] = []

    async def register(names: KeyTurns, name: str, mark: str, go: asyncio.Event) -> None:
        async with names.of_name(name):
            order.append(f"{mark} in")
            await go.wait()
            order.append(f"{mark} out")

    names, first, second, other = KeyTurns(), asyncio.Event(), asyncio.Event(), asyncio.Event()
    tasks = [
        asyncio.create_task(register(names, "/a", "first", first)),
        asyncio.create_task(register(names, "/a", "second", second)),
        asyncio.create_task(register(names, "/a/b", "other", other)),
    ]
    second.set()
    other.set()
    await tasks[2]
    assert order == ["first in", "other in", "other out"]
    first.set()
    await asyncio.gather(*tasks)
    assert order[3:] == ["first out", "second in", "second out"]
    assert len(names) == 0


async def test_a_failure_and_a_cancellation_let_the_next_one_in() -> None:
    async def fail(names: KeyTurns) -> None:
        async with names.of_name("/a"):
            await asyncio.sleep(0)
            raise ValueError

    names = KeyTurns()
    failing, waiting = asyncio.create_task(fail(names)), asyncio.create_task(fail(names))
    await asyncio.sleep(0)
    waiting.cancel()
    await asyncio.gather(failing, waiting, return_exceptions=True)
    async with names.of_name("/a"):
        assert len(names) == 1
    assert len(names) == 0
