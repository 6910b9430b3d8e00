import asyncio
import socket
from collections.abc import AsyncIterator
from typing import Any

import pytest

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
from appliance.control.links.supervisor_link import ROUTES_AT_ONCE, ControlLifeline

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("sockets")]

_LIMIT_SECONDS = 30


class Supervisor:
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
        async with asyncio.timeout(_LIMIT_SECONDS):
            while len(self.asked) < count:
                self._more.clear()
                await self._more.wait()

    def answer(self, host: str) -> None:
        self.say(RouteFound(host, f"way to {host}"))

    def say(self, message: Message) -> None:
        self._channel.send(message)

    def close(self) -> None:
        self._channel.close()


@pytest.fixture
def answers() -> list[TunnelsEnclosed]:
    return []


@pytest.fixture
async def ends(answers: list[TunnelsEnclosed]) -> AsyncIterator[tuple[ControlLifeline, Supervisor]]:
    ours, theirs = socket.socketpair()
    lifeline = ControlLifeline(theirs.detach(), asyncio.Event(), {})
    lifeline.hear_tunnels(answers.append)
    supervisor = Supervisor(ours)
    lifeline.attach()
    yield lifeline, supervisor
    supervisor.close()
    lifeline.channel.close()


async def test_a_route_is_requested_once(ends: tuple[ControlLifeline, Supervisor]) -> None:
    lifeline, supervisor = ends
    many = [asyncio.create_task(lifeline.questions.route_to("a")) for _ in range(50)]
    await supervisor.until_asked(1)
    supervisor.answer("a")
    assert set(await asyncio.gather(*many)) == {"way to a"}
    again = asyncio.create_task(lifeline.questions.route_to("a"))
    await supervisor.until_asked(2)
    assert supervisor.asked == ["a", "a"]
    supervisor.answer("a")
    await again


async def test_routes_of_many_hosts_are_requested_in_turns(ends: tuple[ControlLifeline, Supervisor]) -> None:
    lifeline, supervisor = ends
    hosts = [f"host {number}" for number in range(ROUTES_AT_ONCE * 4)]
    tasks = {host: asyncio.create_task(lifeline.questions.route_to(host)) for host in hosts}
    await supervisor.until_asked(ROUTES_AT_ONCE)
    given_up = [tasks.pop(host) for host in (hosts[0], hosts[-1])]  # one asked, one in the queue
    for one in given_up:
        one.cancel()
    await asyncio.gather(*given_up, return_exceptions=True)
    for number, host in enumerate(hosts[:-1]):
        await supervisor.until_asked(number + 1)
        assert len(supervisor.asked) <= ROUTES_AT_ONCE + number
        supervisor.answer(host)
    assert await asyncio.gather(*tasks.values()) == [f"way to {host}" for host in tasks]
    assert hosts[-1] not in supervisor.asked


async def test_early_messages_are_not_lost(
    ends: tuple[ControlLifeline, Supervisor], answers: list[TunnelsEnclosed]
) -> None:
    lifeline, supervisor = ends
    lifeline, supervisor = ends
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
