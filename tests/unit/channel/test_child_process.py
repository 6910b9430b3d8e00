"""Tests of what the children of the supervisor have in common, with the supervisor's and control's ends in hand."""

import asyncio
import socket
from collections.abc import Callable, Coroutine
from typing import Any

from appliance.channel.channel import Channel
from appliance.channel.child_process import Child
from appliance.channel.messages import (
    AuthorityStated,
    AuthorityWanted,
    Lifeline,
    LinkOpened,
    Ping,
    Pong,
    Ready,
    SignerLink,
    Stop,
)


class Bench:
    """A child that answers every question with its number; `heard` is what its supervisor hears."""

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
        """Give it a link: control's end, and what comes there (None: it was closed)."""
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


def run(work: Callable[[Bench], Coroutine[Any, Any, None]]) -> None:
    """Run a test's work."""

    async def inside() -> None:
        bench = Bench()
        assert await bench.heard.get() == Ready({"x": 1})
        try:
            async with asyncio.timeout(30):
                await work(bench)
        finally:
            bench.child.close()
            for channel in bench.open:
                channel.close()

    asyncio.run(inside())


def test_it_answers_pings_and_ends_when_told() -> None:
    """The supervisor sees that it lives; `Stop` ends it."""

    async def work(bench: Bench) -> None:
        bench.lifeline.send(Ping(7))
        assert await bench.heard.get() == Pong(7)
        bench.lifeline.send(Stop())
        await bench.child.ended.wait()

    run(work)


def test_it_ends_with_its_supervisor() -> None:
    """Nobody is left behind when the supervisor dies."""

    async def work(bench: Bench) -> None:
        bench.lifeline.close()
        await bench.child.ended.wait()

    run(work)


def test_a_new_link_takes_the_place_of_the_one_before() -> None:
    """A control that was started again is served; the old link is closed; what is told in between is dropped."""

    async def work(bench: Bench) -> None:
        bench.child.tell(AuthorityStated(0, b""))
        first, came_first = bench.link()
        first.send(AuthorityWanted(1))
        assert (await came_first.get()).number == 1
        second, came_second = bench.link()
        assert await came_first.get() is None
        second.send(AuthorityWanted(2))
        assert (await came_second.get()).number == 2
        assert bench.links == 2
        second.close()

    run(work)


def test_descriptors_that_are_not_for_it_are_closed() -> None:
    """A link to somebody else is not kept open."""

    async def work(bench: Bench) -> None:
        _channel, came = bench.link("relay")
        assert await came.get() is None
        assert bench.links == 0

    run(work)
