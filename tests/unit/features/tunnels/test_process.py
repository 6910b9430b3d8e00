import asyncio
import queue
import socket
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from appliance.channel.channel import Channel
from appliance.channel.messages import (
    Esp,
    Failed,
    Lifeline,
    LinkOpened,
    Stop,
    TunnelChanged,
    TunnelLink,
    TunnelRefused,
    TunnelSeen,
    TunnelsReported,
    TunnelsStated,
)
from appliance.features.tunnels import process
from appliance.features.tunnels.charon import ViciClient
from appliance.ipsec.requests import make_key
from appliance.ipsec.strongswan import Proposals
from tests.support.idle import idle, replace

pytestmark = pytest.mark.anyio

_LIMIT_SECONDS = 30


@asynccontextmanager
async def running(
    directory: Path, told: Callable[[Any], None], esp: Esp = "kernel"
) -> AsyncIterator[tuple[process.TunnelProcess, asyncio.Task[None]]]:
    """Run the process until the end of the block. `told` gets each message to control, and to the supervisor."""
    (ours, theirs), (lifeline, child) = socket.socketpair(), socket.socketpair()
    channels = own, supervisor, link = (
        Channel(child, Lifeline), Channel(lifeline, Lifeline), Channel(ours, TunnelLink),
    )  # fmt: skip
    tunnels = process.TunnelProcess(own, directory, make_key())
    task = asyncio.create_task(tunnels.run())
    for channel in (supervisor, link):
        channel.attach(asyncio.get_running_loop(), lambda message, _descriptors: told(message), lambda: None)
    supervisor.send(LinkOpened("control", 0), (theirs.fileno(),))
    theirs.close()
    link.send(TunnelsStated(7, esp, "10.113.11.1", b"a", b"c", b"r", []))
    yield tunnels, task
    supervisor.send(Stop())
    await asyncio.wait_for(task, _LIMIT_SECONDS)
    for channel in channels:
        channel.close()


def charon_that(**methods: Callable[..., object]) -> ViciClient:
    client = idle(ViciClient)
    replace(client, **methods)
    return client


@pytest.mark.nightly
async def test_charon_gets_one_request_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "REPORT_SECONDS", 0.01)
    busy, interrupted, taken = threading.Event(), threading.Event(), asyncio.Event()

    def provision(_stated: TunnelsStated) -> None:
        busy.set()
        interrupted.wait(0.3)
        busy.clear()

    def seen() -> list[TunnelSeen]:
        if busy.is_set():
            interrupted.set()
        return []

    async def start(_tunnels: process.TunnelProcess, _wanted: TunnelsStated) -> ViciClient:
        return charon_that(provision=provision, list_tunnels=seen)

    def told(message: Any) -> None:
        if isinstance(message, TunnelsReported) and message.taken == 7:
            taken.set()

    monkeypatch.setattr(process.TunnelProcess, "_start", start)
    async with running(tmp_path, told) as (tunnels, _task):
        await asyncio.wait_for(taken.wait(), _LIMIT_SECONDS)
        assert not interrupted.is_set()
    assert not tunnels.failed


@pytest.mark.nightly
async def test_no_report_is_older_than_the_changes_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Control would count the tunnel as closed, and then as open again."""
    tunnel = TunnelSeen("laptop", "10.88.0.9", 1, 0, 0)
    opened: queue.SimpleQueue[tuple[str, bool, str]] = queue.SimpleQueue()
    listed, changed, reported = threading.Event(), threading.Event(), asyncio.Event()
    messages: list[Any] = []

    def listen() -> Iterator[tuple[str, bool, str]]:
        yield opened.get(timeout=_LIMIT_SECONDS)

    def seen() -> list[TunnelSeen]:
        if listed.is_set():
            return [tunnel]
        listed.set()
        opened.put((tunnel.name, True, tunnel.remote))
        changed.wait(_LIMIT_SECONDS)
        return []

    async def start(self: process.TunnelProcess, _wanted: TunnelsStated) -> ViciClient:
        vici = charon_that(listen=listen, list_tunnels=seen)
        asyncio.get_running_loop().run_in_executor(None, self._listen, vici)
        return vici

    def told(message: Any) -> None:
        if isinstance(message, TunnelChanged | TunnelsReported):
            messages.append(message)
            (changed if isinstance(message, TunnelChanged) else reported).set()

    monkeypatch.setattr(process.TunnelProcess, "_start", start)
    async with running(tmp_path, told):
        await asyncio.wait_for(reported.wait(), _LIMIT_SECONDS)
        assert messages == [TunnelChanged("laptop", True, "10.88.0.9"), TunnelsReported(7, [tunnel])]


async def failure_of(directory: Path, esp: Esp) -> Failed:
    failure: asyncio.Future[Failed] = asyncio.get_running_loop().create_future()

    def told(message: Any) -> None:
        if isinstance(message, Failed):
            failure.set_result(message)

    async with running(directory, told, esp) as (tunnels, task):
        await asyncio.wait_for(task, _LIMIT_SECONDS)
        assert tunnels.failed
        return await asyncio.wait_for(failure, _LIMIT_SECONDS)


@pytest.mark.nightly
async def test_the_last_output_of_charon_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "charon"
    program.write_text("#!/bin/sh\nseq 1 100 >&2\nhead -c 9000 /dev/zero | tr '\\0' x >&2\nkill -SEGV $$\n")
    program.chmod(0o700)
    monkeypatch.setattr(process, "PROGRAM", program)
    monkeypatch.setattr(process, "clear_leftovers", lambda _address: None)
    said = await failure_of(tmp_path, "kernel")
    assert said.output == [*map(str, range(62, 101)), "x" * 500]
    assert said.reason.startswith("charon exited by SIGSEGV; its last output: xxx")


@pytest.mark.nightly
async def test_refusals_beyond_the_share_of_an_address_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program, wanted = tmp_path / "charon", 50
    program.write_text(
        "#!/bin/sh\n"
        f"for one in $(seq {wanted}); do\n"
        "    echo '09[NET] received packet: from 10.88.0.66[500] to 10.88.0.2[500] (268 bytes)' >&2\n"
        "    echo '09[ENC] generating IKE_AUTH response 1 [ N(AUTH_FAILED) ]' >&2\n"
        "done\nexec sleep 60\n"
    )
    program.chmod(0o700)
    counted, whole, heard = 0, asyncio.Event(), list[TunnelRefused]()

    async def connect(_tunnels: process.TunnelProcess, _path: Path) -> ViciClient:
        charon = charon_that(
            load_key=lambda _key: None,
            provision=lambda _one: None,
            version=lambda: "6",
            list_tunnels=list,
            listen=list,
        )
        charon.proposals = Proposals()
        return charon

    def told(message: Any) -> None:
        nonlocal counted
        if isinstance(message, TunnelRefused):
            heard.append(message)
            counted += int(message.reason.split()[0]) if "more" in message.reason else 1
            if counted == wanted:
                whole.set()

    monkeypatch.setattr(process, "PROGRAM", program)
    monkeypatch.setattr(process, "clear_leftovers", lambda _address: None)
    monkeypatch.setattr(process, "REPORT_SECONDS", 0.05)
    monkeypatch.setattr(process.TunnelProcess, "_connect", connect)
    async with running(tmp_path, told):
        await asyncio.wait_for(whole.wait(), _LIMIT_SECONDS)
    assert {one.remote for one in heard} == {"10.88.0.66"}
    assert len(heard) < wanted


@pytest.mark.nightly
async def test_charon_is_not_started_without_its_device(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "PROGRAM", tmp_path / "none")
    monkeypatch.setattr(process, "TUN", tmp_path / "tun")
    said = await failure_of(tmp_path, "user space")
    assert said.reason.startswith(f"{tmp_path}/tun cannot be opened by user")
    assert "load the kernel module `tun`" in said.reason
