"""Registering calls under one name wait for each other; other names do not."""

import asyncio

from appliance.master.calls.call_order import Claims


def test_one_after_the_other_by_name() -> None:
    """Under one name they go in the order they came; nothing is kept of a name that is not in use."""
    order: list[str] = []

    async def register(claims: Claims, name: str, mark: str, go: asyncio.Event) -> None:
        async with claims.alone(name):
            order.append(f"{mark} in")
            await go.wait()
            order.append(f"{mark} out")

    async def scene() -> None:
        claims, first, second, other = Claims(), asyncio.Event(), asyncio.Event(), asyncio.Event()
        tasks = [
            asyncio.create_task(register(claims, "/a", "first", first)),
            asyncio.create_task(register(claims, "/a", "second", second)),
            asyncio.create_task(register(claims, "/b", "other", other)),
        ]
        second.set()
        other.set()
        await tasks[2]
        assert order == ["first in", "other in", "other out"]
        first.set()
        await asyncio.gather(*tasks)
        assert order[3:] == ["first out", "second in", "second out"]
        assert len(claims) == 0

    asyncio.run(scene())


def test_a_failure_and_a_cancellation_let_the_next_one_in() -> None:
    """Whoever fails, or stops waiting, leaves no lock behind."""

    async def fail(claims: Claims) -> None:
        async with claims.alone("/a"):
            await asyncio.sleep(0)
            raise ValueError

    async def scene() -> None:
        claims = Claims()
        failing, waiting = asyncio.create_task(fail(claims)), asyncio.create_task(fail(claims))
        await asyncio.sleep(0)
        waiting.cancel()
        await asyncio.gather(failing, waiting, return_exceptions=True)
        async with claims.alone("/a"):
            assert len(claims) == 1
        assert len(claims) == 0

    asyncio.run(scene())
