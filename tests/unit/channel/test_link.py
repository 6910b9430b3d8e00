import asyncio
import socket
from collections.abc import Iterator

import pytest

from appliance.channel.channel import Channel, ChannelClosedError
from appliance.channel.link import Link
from appliance.channel.messages import Ping, Pong
from tests.support.heard import Heard

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("sockets")]


class World:
    def __init__(self) -> None:
        self.heard: list[object] = []
        self.lost: list[str] = []
        self.link = Link(self._hear, self.lost.append)
        self.ends: list[Channel] = []

    def _hear(self, message: object) -> None:
        self.heard.append(message)
        if isinstance(message, Pong):
            self.link.answered(message.number, message)

    def life(self) -> Channel:
        here, there = socket.socketpair()
        self.link.attach(Channel(here, Ping | Pong))
        self.ends.append(Channel(there, Ping | Pong))
        return self.ends[-1]


@pytest.fixture
def world() -> Iterator[World]:
    world = World()
    yield world
    world.link.close()
    for end in world.ends:
        end.close()


async def test_an_answer_has_the_number_of_its_question(world: World) -> None:
    ear = Heard(other := world.life())
    asked = [asyncio.ensure_future(world.link.ask(Ping, 10)) for _turn in range(2)]
    pings = await ear.until(2)
    assert world.link.unanswered == 2
    for number in (99, *(ping.number for ping in reversed(pings))):
        other.send(Pong(number))
    assert await asyncio.gather(*asked) == [Pong(ping.number) for ping in pings]
    assert world.link.unanswered == 0


async def test_a_replaced_peer_is_ignored_and_owes_no_answer(world: World) -> None:
    before = world.life()
    asked = asyncio.ensure_future(world.link.ask(Ping, 10))
    await asyncio.sleep(0)
    before.send(Pong(1))
    ear = Heard(now := world.life())
    with pytest.raises(ChannelClosedError):
        await asked
    assert world.link.send(Ping(7))
    assert await ear.until(1) == [Ping(7)]
    assert (world.heard, world.lost) == ([], [])
    now.close()
    async with asyncio.timeout(10):
        while not world.lost:
            await asyncio.sleep(0)
    assert world.lost == [""]


async def test_without_a_peer_messages_and_questions_fail(world: World) -> None:
    assert not world.link.send(Ping(1))
    with pytest.raises(ChannelClosedError):
        await world.link.ask(Ping, 10)
    world.life()
    with pytest.raises(TimeoutError):
        await world.link.ask(Ping, 0)
    assert world.link.unanswered == 0
