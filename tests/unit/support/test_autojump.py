import asyncio
import socket
import threading
from typing import cast

import pytest

from appliance.base import clock
from tests.support.autojump import DeadlockError, RealLoopError, run

pytestmark = pytest.mark.anyio


async def test_a_year_passes_at_once() -> None:
    loop = asyncio.get_running_loop()
    before = loop.time(), clock.now(), clock.wall()
    await asyncio.sleep(365 * 86_400)
    after = loop.time(), clock.now(), clock.wall()
    assert [late - early for early, late in zip(before, after, strict=True)] == pytest.approx(
        [365 * 86_400] * 3
    )
    assert loop.time() == clock.now()


async def test_timers_fire_in_the_order_of_their_times() -> None:
    loop, fired = asyncio.get_running_loop(), list[float]()
    began = loop.time()
    for seconds in (3.0, 0.1, 2.0, 0.0):
        loop.call_later(seconds, lambda: fired.append(round(loop.time() - began, 6)))
    await asyncio.sleep(3.0)
    assert fired == [0.0, 0.1, 2.0, 3.0]


async def test_a_time_limit_passes_only_if_nothing_else_can_happen() -> None:
    async def busy() -> str:
        for _ in range(1000):
            await asyncio.sleep(0)
        return "done"

    assert await asyncio.wait_for(busy(), 0.001) == "done"
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(asyncio.Event().wait(), 3600)


async def test_functions_for_threads_run_one_after_another_in_the_loop() -> None:
    order: list[int] = []

    def work(number: int) -> int:
        with pytest.raises(RuntimeError, match="no running event loop"):
            asyncio.get_running_loop()
        order.append(number)
        return threading.get_ident()

    found = await asyncio.gather(*(asyncio.to_thread(work, number) for number in range(5)))
    assert order == [0, 1, 2, 3, 4]
    assert set(found) == {threading.get_ident()}
    with pytest.raises(ZeroDivisionError):
        await asyncio.get_running_loop().run_in_executor(None, lambda: 1 // 0)


async def test_a_cancelled_function_does_not_run() -> None:
    ran: list[int] = []
    future = asyncio.get_running_loop().run_in_executor(None, ran.append, 1)
    future.cancel()
    await asyncio.sleep(1)
    assert ran == []


def test_a_deadlock_names_what_the_tasks_wait_for() -> None:
    async def never() -> None:
        await asyncio.Event().wait()

    with pytest.raises(DeadlockError, match=r"1 tasks wait for ever\n  .*locks\.py:\d+ Event\.wait"):
        run(never())


def test_a_poll_without_end_fails() -> None:
    async def poll() -> None:
        while True:
            await asyncio.sleep(0.01)

    with pytest.raises(DeadlockError, match=r"^100 timers have passed in vain"):
        run(poll(), most_jumps=100)


async def test_a_socket_and_a_program_are_refused() -> None:
    for use in (
        asyncio.open_connection("127.0.0.1", 1),
        asyncio.create_subprocess_exec("true"),
        asyncio.get_running_loop().sock_recv(cast(socket.socket, None), 1),
    ):
        with pytest.raises(RealLoopError, match="mark the test `real`"):
            await use


async def test_a_descriptor_and_another_thread_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = asyncio.get_running_loop()
    with pytest.raises(RealLoopError):
        loop.add_reader(0, print)
    loop.call_soon_threadsafe(print)
    monkeypatch.setattr(threading, "get_ident", lambda: 0)
    with pytest.raises(RealLoopError):
        loop.call_soon_threadsafe(print)
