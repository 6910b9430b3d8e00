"""Tests of the process that speaks to charon, with a stand-in for the conversation."""

import asyncio
import socket
import threading
from pathlib import Path
from typing import Any, cast

import pytest

from appliance.channel.channel import Channel
from appliance.channel.messages import (
    Lifeline,
    LinkOpened,
    Stop,
    TunnelLink,
    TunnelSeen,
    TunnelsReported,
    TunnelsStated,
)
from appliance.ipsec import process
from appliance.ipsec.charon import Vici
from appliance.ipsec.requests import make_key

_LIMIT_SECONDS = 30


class Conversation:
    """Takes what is stated as long as nobody asks for the tunnels meanwhile, or a little longer than that takes."""

    def __init__(self) -> None:
        self._busy = threading.Event()
        self.interrupted = threading.Event()

    def provision(self, _stated: TunnelsStated) -> None:
        """Is asked for the tunnels in the middle, or is not."""
        self._busy.set()
        self.interrupted.wait(0.3)
        self._busy.clear()

    def seen(self) -> list[TunnelSeen]:
        """None; notes whether something else is being asked."""
        if self._busy.is_set():
            self.interrupted.set()
        return []


class Bench(process.TunnelProcess):
    """The process, with the stand-in in the place of charon."""

    conversation = Conversation()

    async def _start(self, _wanted: TunnelsStated) -> Vici:
        return cast(Vici, self.conversation)


def test_charon_is_asked_one_thing_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The look at the tunnels waits until what is stated was taken: both would read each other's answers."""
    monkeypatch.setattr(process, "REPORT_SECONDS", 0.01)

    async def work() -> None:
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

    asyncio.run(work())
