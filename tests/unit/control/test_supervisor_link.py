"""Tests of control's end of its lifeline, with the supervisor's in hand."""

import asyncio
import socket
from collections.abc import Callable, Coroutine
from typing import Any

from appliance.channel.channel import Channel
from appliance.channel.messages import (
    Announced,
    Lifeline,
    Message,
    PolicyReloadRequested,
    ProbePassed,
    RouteFound,
    RouteWanted,
    SocketsRestored,
    TunnelsEnclosed,
)
from appliance.control.supervisor_link import ROUTES_AT_ONCE, ControlLifeline

_LIMIT_SECONDS = 30


class Supervisor:
    """The other end; `asked` are the hosts whose routes control wants to know."""

    def __init__(self, sock: socket.socket) -> None:
        self.asked: list[str] = []
        self._channel = Channel(sock, Lifeline)
        self._channel.attach(asyncio.get_running_loop(), self._received, lambda: None)
        self._more = asyncio.Event()

    def _received(self, message: Any, _descriptors: tuple[int, ...]) -> None:
        assert isinstance(message, RouteWanted)
        self.asked.append(message.host)
        self._more.set()

    async def until_asked(self, count: int) -> None:
        """Wait for so many questions."""
        async with asyncio.timeout(_LIMIT_SECONDS):
            while len(self.asked) < count:
                self._more.clear()
                await self._more.wait()

    def answer(self, host: str) -> None:
        """The way to a host."""
        self.say(RouteFound(host, f"way to {host}"))

    def say(self, message: Message) -> None:
        """Tell control something."""
        self._channel.send(message)

    def close(self) -> None:
        """End it."""
        self._channel.close()


def run(
    work: Callable[[ControlLifeline, Supervisor], Coroutine[Any, Any, None]],
    enclosed: Callable[[TunnelsEnclosed], None] = print,
) -> None:
    """A test's work on both ends."""

    async def inside() -> None:
        ours, theirs = socket.socketpair()
        stopping = asyncio.Event()
        lifeline, supervisor = ControlLifeline(theirs.detach(), stopping, enclosed, print), Supervisor(ours)
        lifeline.attach()
        try:
            await work(lifeline, supervisor)
        finally:
            supervisor.close()
            lifeline.channel.close()

    asyncio.run(inside())


def test_the_way_to_a_host_is_asked_once() -> None:
    """However many wait for it; whoever comes later asks anew."""

    async def work(lifeline: ControlLifeline, supervisor: Supervisor) -> None:
        many = [asyncio.create_task(lifeline.route_to("a")) for _ in range(50)]
        await supervisor.until_asked(1)
        supervisor.answer("a")
        assert set(await asyncio.gather(*many)) == {"way to a"}
        again = asyncio.create_task(lifeline.route_to("a"))
        await supervisor.until_asked(2)
        assert supervisor.asked == ["a", "a"]
        supervisor.answer("a")
        await again

    run(work)


def test_many_strangers_are_asked_for_in_turns() -> None:
    """The supervisor never has more than a few questions open, those who gave up counted; all are answered."""

    async def work(lifeline: ControlLifeline, supervisor: Supervisor) -> None:
        hosts = [f"host {number}" for number in range(ROUTES_AT_ONCE * 4)]
        tasks = {host: asyncio.create_task(lifeline.route_to(host)) for host in hosts}
        await supervisor.until_asked(ROUTES_AT_ONCE)
        given_up = [
            tasks.pop(host) for host in (hosts[0], hosts[-1])
        ]  # one that was asked for, one that waits
        for one in given_up:
            one.cancel()
        await asyncio.gather(*given_up, return_exceptions=True)
        for number, host in enumerate(hosts[:-1]):
            await supervisor.until_asked(number + 1)
            assert len(supervisor.asked) <= ROUTES_AT_ONCE + number
            supervisor.answer(host)
        assert await asyncio.gather(*tasks.values()) == [f"way to {host}" for host in tasks]
        assert hosts[-1] not in supervisor.asked

    run(work)


def test_nothing_that_comes_early_is_lost() -> None:
    """What other parts of control are to hear waits for them, in order; an answer that one waits for does not."""
    answers: list[TunnelsEnclosed] = []

    async def work(lifeline: ControlLifeline, supervisor: Supervisor) -> None:
        for message in (Announced(), PolicyReloadRequested(), TunnelsEnclosed("kernel"), SocketsRestored(0)):
            supervisor.say(message)
        await lifeline.restored.wait()
        assert answers == [TunnelsEnclosed("kernel")]
        heard: list[Any] = []
        more = asyncio.Event()

        def hear(message: Any, descriptors: tuple[int, ...]) -> None:
            assert not descriptors
            heard.append(message)
            more.set()

        lifeline.hear(hear)
        assert heard == [Announced(), PolicyReloadRequested()]
        more.clear()
        supervisor.say(ProbePassed())
        await more.wait()
        assert heard[2:] == [ProbePassed()]
        assert lifeline.surroundings.probe == "passed"

    run(work, answers.append)
