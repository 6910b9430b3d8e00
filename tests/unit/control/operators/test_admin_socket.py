import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from appliance.base.withdrawal import take_effect
from appliance.channel.admin import AdminAnswer, PolicyConfirm, decode, encode
from appliance.channel.answers.policy_answers import PolicyConfirmed
from appliance.cli.connection import admin_client
from appliance.cli.connection.admin_client import ADMIN_SOCKET, AdminSocket, NotRunningError
from appliance.control.operators.admin_socket import AdminServer
from appliance.control.operators.request_method import RequestMethod
from tests.support.administrations import administration_of

pytestmark = pytest.mark.anyio


class Slow:
    def __init__(self) -> None:
        self.begun, self.goes_on = asyncio.Event(), asyncio.Event()
        self.ended: asyncio.Queue[str] = asyncio.Queue()
        self.done = 0

    async def confirm(self, _request: PolicyConfirm, who: str) -> PolicyConfirmed:
        self.begun.set()
        try:
            await self.goes_on.wait()
            take_effect()
            self.done += 1
            return PolicyConfirmed(True, self.done)
        finally:
            self.ended.put_nowait(who)


@contextlib.asynccontextmanager
async def served(state: Path) -> AsyncIterator[Slow]:
    slow = Slow()
    administration = administration_of(RequestMethod(PolicyConfirm, slow.confirm, who=True))
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listening.bind(str(state / ADMIN_SOCKET))
    listening.listen()
    server = await AdminServer(administration).start(listening)
    try:
        yield slow
    finally:
        server.close()


@pytest.mark.nightly
async def test_an_order_past_its_timeout_is_withdrawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with served(tmp_path) as slow:
        monkeypatch.setattr(socket.socket, "shutdown", _then(socket.socket.shutdown, slow.goes_on.set))
        answer = await asyncio.to_thread(AdminSocket(tmp_path, 0.05).ask, PolicyConfirm())
        assert (answer.ok, answer.trouble, slow.done) == (False, "busy", 0)
        assert "nothing was changed" in answer.error


@pytest.mark.nightly
async def test_a_late_order_that_took_effect_is_answered(tmp_path: Path) -> None:
    async with served(tmp_path) as slow:
        slow.goes_on.set()
        answer = await asyncio.to_thread(AdminSocket(tmp_path, 20.0).ask, PolicyConfirm())
        assert (answer.ok, slow.done) == (True, 1)


@pytest.mark.nightly
async def test_a_tool_without_an_answer_says_how_to_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(admin_client, "_GRACE_SECONDS", 0.05)
    wanted = pytest.raises(NotRunningError, match=r"may have taken effect; .* rosrv audit search --since 5m")
    async with served(tmp_path) as slow:
        # An order that has not begun is answered when it is withdrawn.
        monkeypatch.setattr(socket.socket, "shutdown", _once(slow.begun, socket.socket.shutdown))
        with wanted:
            await asyncio.to_thread(AdminSocket(tmp_path, 0.05).ask, PolicyConfirm())


@pytest.mark.nightly
async def test_the_order_of_a_killed_tool_is_withdrawn(tmp_path: Path) -> None:
    async with served(tmp_path) as slow:
        _reader, writer = await asyncio.open_unix_connection(tmp_path / ADMIN_SOCKET)
        writer.write(encode(PolicyConfirm()) + b"\n")
        await slow.begun.wait()
        writer.transport.abort()
        await asyncio.sleep(0)
        slow.goes_on.set()
        assert await slow.ended.get() == "operator"
        assert slow.done == 0
        reader, writer = await asyncio.open_unix_connection(tmp_path / ADMIN_SOCKET)
        writer.write(encode(PolicyConfirm()) + b"\n")
        answer: AdminAnswer[PolicyConfirmed] = decode(await reader.readline(), PolicyConfirm())
        assert (answer.ok, slow.done) == (True, 1)
        writer.close()


def _once(event: asyncio.Event, method: Any) -> Any:
    """Return the method behind a wait for the event, which lets other threads call it in the meantime."""
    loop = asyncio.get_running_loop()

    def later(*arguments: Any) -> Any:
        asyncio.run_coroutine_threadsafe(event.wait(), loop).result(30)
        return method(*arguments)

    return later


def _then(method: Any, after: Any) -> Any:
    loop = asyncio.get_running_loop()

    def both(*arguments: Any) -> Any:
        result = method(*arguments)
        loop.call_soon_threadsafe(after)
        return result

    return both


async def test_an_order_that_ends_by_a_defect_is_answered() -> None:
    async def confirm(_request: PolicyConfirm, who: str) -> PolicyConfirmed:
        raise FileNotFoundError(f"no presets for {who}")

    server = AdminServer(administration_of(RequestMethod(PolicyConfirm, confirm, who=True)))
    answer = await server.answer(encode(PolicyConfirm()))
    assert (answer.ok, answer.trouble) == (False, "failed")
    assert "a defect in rosrv, please report it" in str(answer.error)
    assert "no presets for operator" in str(answer.error)
