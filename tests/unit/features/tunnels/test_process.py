import asyncio
import queue
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

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
    TunnelSeen,
    TunnelsReported,
    TunnelsStated,
)
from appliance.features.tunnels import process
from appliance.features.tunnels.charon import ViciClient
from appliance.ipsec.requests import make_key

pytestmark = pytest.mark.anyio

_LIMIT_SECONDS = 30


class Conversation:
    def __init__(self) -> None:
        self._busy = threading.Event()
        self.interrupted = threading.Event()
        self.told = threading.Event()

    def provision(self, _stated: TunnelsStated) -> None:
        self._busy.set()
        self.interrupted.wait(0.3)
        self._busy.clear()

    def seen(self) -> list[TunnelSeen]:
        if self._busy.is_set():
            self.interrupted.set()
        return []


class Bench(process.TunnelProcess):
    conversation: Conversation = Conversation()

    async def _start(self, _wanted: TunnelsStated) -> ViciClient:
        return cast(ViciClient, self.conversation)


@pytest.mark.nightly
async def test_charon_gets_one_request_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "REPORT_SECONDS", 0.01)
    (ours, theirs), (lifeline, child) = socket.socketpair(), socket.socketpair()
    own, supervisor, link = (
        Channel(child, Lifeline),
        Channel(lifeline, Lifeline),
        Channel(ours, TunnelLink),
    )
    bench = Bench(own, tmp_path, make_key())
    running = asyncio.create_task(bench.run())
    supervisor.send(LinkOpened("control", 0), (theirs.fileno(),))
    theirs.close()
    taken = asyncio.Event()

    def heard(message: Any, _descriptors: tuple[int, ...]) -> None:
        if isinstance(message, TunnelsReported) and message.taken == 7:
            taken.set()

    link.attach(asyncio.get_running_loop(), heard, taken.set)
    link.send(TunnelsStated(7, "kernel", "10.113.11.1", b"a", b"c", b"r", []))
    await asyncio.wait_for(taken.wait(), _LIMIT_SECONDS)
    assert not bench.conversation.interrupted.is_set()
    supervisor.send(Stop())
    await asyncio.wait_for(running, _LIMIT_SECONDS)
    assert not bench.failed
    for one in (own, supervisor, link):
        one.close()


class Opening(Conversation):
    tunnel = TunnelSeen("laptop", "10.88.0.9", 1, 0, 0)

    def __init__(self) -> None:
        super().__init__()
        self._opened: queue.SimpleQueue[tuple[str, bool, str]] = queue.SimpleQueue()
        self._listed = False

    def listen(self) -> Iterator[tuple[str, bool, str]]:
        yield self._opened.get(timeout=_LIMIT_SECONDS)

    def seen(self) -> list[TunnelSeen]:
        listed, self._listed = self._listed, True
        if not listed:
            self._opened.put((self.tunnel.name, True, self.tunnel.remote))
            self.told.wait(_LIMIT_SECONDS)
        return [self.tunnel] if listed else []


class ListeningBench(Bench):
    async def _start(self, _wanted: TunnelsStated) -> ViciClient:
        vici = cast(ViciClient, self.conversation)
        self._loop.run_in_executor(None, self._listen, vici)
        return vici


@pytest.mark.nightly
async def test_no_report_is_older_than_the_changes_before_it(tmp_path: Path) -> None:
    """Control would count the tunnel as closed, and then as open again."""
    (ours, theirs), (lifeline, child) = socket.socketpair(), socket.socketpair()
    own, supervisor, link = Channel(child, Lifeline), Channel(lifeline, Lifeline), Channel(ours, TunnelLink)
    bench = ListeningBench(own, tmp_path, make_key())
    bench.conversation = Opening()
    running = asyncio.create_task(bench.run())
    supervisor.send(LinkOpened("control", 0), (theirs.fileno(),))
    theirs.close()
    told: list[Any] = []
    reported = asyncio.Event()

    def heard(message: Any, _descriptors: tuple[int, ...]) -> None:
        if isinstance(message, TunnelChanged | TunnelsReported):
            told.append(message)
        if isinstance(message, TunnelChanged):
            bench.conversation.told.set()
        if isinstance(message, TunnelsReported):
            reported.set()

    link.attach(asyncio.get_running_loop(), heard, reported.set)
    link.send(TunnelsStated(7, "kernel", "10.113.11.1", b"a", b"c", b"r", []))
    await asyncio.wait_for(reported.wait(), _LIMIT_SECONDS)
    assert told == [TunnelChanged("laptop", True, "10.88.0.9"), TunnelsReported(7, [Opening.tunnel])]
    supervisor.send(Stop())
    await asyncio.wait_for(running, _LIMIT_SECONDS)
    for one in (own, supervisor, link):
        one.close()


def failure_of(directory: Path, esp: Esp) -> Failed:
    async def work() -> Failed:
        (ours, theirs), (lifeline, child) = socket.socketpair(), socket.socketpair()
        own, supervisor, link = (
            Channel(child, Lifeline),
            Channel(lifeline, Lifeline),
            Channel(ours, TunnelLink),
        )
        running = asyncio.create_task((failing := process.TunnelProcess(own, directory, make_key())).run())
        heard: asyncio.Future[Failed] = asyncio.get_running_loop().create_future()

        def received(message: Any, _descriptors: tuple[int, ...]) -> None:
            if isinstance(message, Failed):
                heard.set_result(message)

        supervisor.attach(asyncio.get_running_loop(), received, lambda: None)
        supervisor.send(LinkOpened("control", 0), (theirs.fileno(),))
        theirs.close()
        link.send(TunnelsStated(7, esp, "10.113.11.1", b"a", b"c", b"r", []))
        await asyncio.wait_for(running, _LIMIT_SECONDS)
        assert failing.failed
        said = await asyncio.wait_for(heard, _LIMIT_SECONDS)
        for one in (own, supervisor, link):
            one.close()
        return said

    return asyncio.run(work())


@pytest.mark.nightly
def test_the_last_output_of_charon_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "charon"
    program.write_text("#!/bin/sh\nseq 1 100 >&2\nhead -c 9000 /dev/zero | tr '\\0' x >&2\nkill -SEGV $$\n")
    program.chmod(0o700)
    monkeypatch.setattr(process, "PROGRAM", program)
    monkeypatch.setattr(process, "clear_leftovers", lambda _address: None)
    said = failure_of(tmp_path, "kernel")
    assert said.output == [*map(str, range(62, 101)), "x" * 500]
    assert said.reason.startswith("charon exited by SIGSEGV; its last output: xxx")


@pytest.mark.nightly
def test_charon_is_not_started_without_its_device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "PROGRAM", tmp_path / "none")
    monkeypatch.setattr(process, "TUN", tmp_path / "tun")
    said = failure_of(tmp_path, "user space")
    assert said.reason.startswith(f"{tmp_path}/tun cannot be opened by user")
    assert "load the kernel module `tun`" in said.reason
