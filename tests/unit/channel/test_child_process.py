import asyncio
import socket
from collections.abc import AsyncIterator
from typing import Any

import pytest

from appliance.channel.channel import Channel
from appliance.channel.child_process import Child
from appliance.channel.messages import (
    AuthorityRequest,
    AuthorityStated,
    Lifeline,
    LinkOpened,
    Ping,
    Pong,
    Ready,
    SignerLink,
    Stop,
)

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("sockets")]


class Bench:
    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        self.lifeline, self.heard = Channel(ours, Lifeline), asyncio.Queue[Any]()
        self.links = 0
        self.open = [self.lifeline, Channel(theirs, Lifeline)]
        self.child = Child(self.open[1], SignerLink, said=self._said, linked=self._linked)
        self.lifeline.attach(
            asyncio.get_running_loop(),
            lambda message, _descriptors: self.heard.put_nowait(message),
            lambda: None,
        )
        self.child.attach(Ready({"x": 1}))

    def _said(self, message: Any) -> None:
        self.child.tell(AuthorityStated(message.number, b"pem"))

    def _linked(self) -> None:
        self.links += 1

    def link(self, role: str = "control") -> tuple[Channel, asyncio.Queue[Any]]:
        ours, theirs = socket.socketpair()
        self.lifeline.send(LinkOpened(role=role, index=0), (theirs.fileno(),))
        theirs.close()
        channel, came = Channel(ours, SignerLink), asyncio.Queue[Any]()
        self.open.append(channel)
        channel.attach(
            asyncio.get_running_loop(),
            lambda message, _descriptors: came.put_nowait(message),
            lambda: came.put_nowait(None),
        )
        return channel, came


@pytest.fixture
async def bench() -> AsyncIterator[Bench]:
    bench = Bench()
    assert await bench.heard.get() == Ready({"x": 1})
    yield bench
    bench.child.close()
    for channel in bench.open:
        channel.close()


async def test_it_answers_pings_and_stops(bench: Bench) -> None:
    bench.lifeline.send(Ping(7))
    assert await bench.heard.get() == Pong(7)
    bench.lifeline.send(Stop())
    await bench.child.ended.wait()
    assert bench.child.stopped


async def test_a_failure_of_the_appliance_is_not_a_stop_by_order(bench: Bench) -> None:
    bench.lifeline.send(Stop(failed=True))
    await bench.child.ended.wait()
    assert not bench.child.stopped


async def test_it_ends_with_its_supervisor(bench: Bench) -> None:
    bench.lifeline.close()
    await bench.child.ended.wait()
    assert not bench.child.stopped


async def test_a_new_link_replaces_the_old_one(bench: Bench) -> None:
    bench.child.tell(AuthorityStated(0, b""))
    first, came_first = bench.link()
    first.send(AuthorityRequest(1))
    assert (await came_first.get()).number == 1
    second, came_second = bench.link()
    assert await came_first.get() is None
    second.send(AuthorityRequest(2))
    assert (await came_second.get()).number == 2
    assert bench.links == 2
    second.close()


async def test_foreign_descriptors_are_closed(bench: Bench) -> None:
    _channel, came = bench.link("relay")
    assert await came.get() is None
    assert bench.links == 0
