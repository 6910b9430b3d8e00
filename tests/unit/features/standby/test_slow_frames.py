import asyncio
import contextlib
import struct
from random import Random
from typing import Any

import msgspec
import pytest

from appliance.features.standby.replication_frames import (
    Changes,
    FromActive,
    FromStandby,
    ReplicationError,
    ReplicationLink,
    Stored,
)
from appliance.store.changes import Put
from tests.world.loop import Machine, Process, WorldLoop

pytestmark = pytest.mark.anyio

SECONDS = 10.0


class SlowWriter:
    """The end of a connection that takes 100 kB a second."""

    def __init__(self) -> None:
        self.rate, self.left = 100_000, 0

    def write(self, data: bytes) -> None:
        self.left += len(data)

    async def drain(self) -> None:
        await asyncio.sleep(self.left / self.rate)
        self.left = 0


def frame(message: Any) -> bytes:
    body = msgspec.msgpack.encode(message)
    return struct.pack(">I", len(body)) + body


def link_to(reader: asyncio.StreamReader, received: Any) -> ReplicationLink[Any]:
    writer: Any = SlowWriter()
    return ReplicationLink(reader, writer, received)


def large() -> Changes:
    return Changes(1, "h", 1, [Put("parameters", [(1, bytes(5_000_000))])])


async def test_a_large_frame_over_a_slow_link_is_received() -> None:
    """5 MB at 100 kB/s take 50 s; each part of it shows that the other appliance is there."""
    reader, sent, loop = asyncio.StreamReader(), frame(large()), asyncio.get_running_loop()
    for second, begin in enumerate(range(0, len(sent), 100_000)):
        loop.call_later(second, reader.feed_data, sent[begin : begin + 100_000])
    link = link_to(reader, FromActive)
    began = loop.time()
    assert frame(await link.receive(SECONDS)) == sent
    assert loop.time() - began > 4 * SECONDS


async def test_a_frame_that_stops_in_the_middle_ends_the_link() -> None:
    reader = asyncio.StreamReader()
    reader.feed_data(frame(large())[:1_000_000])
    link = link_to(reader, FromActive)
    with pytest.raises(ReplicationError, match="sent nothing for 10 s"):
        await link.receive(SECONDS)
    reader.feed_data(frame(large())[:1_000_000])
    reader.feed_eof()
    with pytest.raises(ReplicationError, match="closed the link"):
        await link.receive(SECONDS)


async def test_an_appliance_that_takes_a_large_frame_is_not_silent() -> None:
    reader, loop = asyncio.StreamReader(), asyncio.get_running_loop()
    link = link_to(reader, FromStandby)
    sending = loop.create_task(link.send(large()))
    sending.add_done_callback(lambda _task: reader.feed_data(frame(Stored(1, "h", 1))))
    began = loop.time()
    assert await link.receive(SECONDS) == Stored(1, "h", 1)
    assert loop.time() - began > 4 * SECONDS
    began = loop.time()
    with pytest.raises(ReplicationError, match="sent nothing for 10 s"):
        await link.receive(SECONDS)
    assert loop.time() - began <= SECONDS


@pytest.mark.parametrize("seed", range(50))
def test_the_wait_for_a_silent_appliance_ends_on_a_clock_of_any_speed(seed: int) -> None:
    """The sum of two times is rounded, so a timer may ring a little before the end that it was set for."""
    random = Random(seed)  # noqa: S311  no secret
    loop = WorldLoop(random)
    machine = Machine("standby", loop, ahead=random.uniform(0, 1000), speed=random.uniform(0.99, 1.01))

    async def receive() -> float:
        link = link_to(asyncio.StreamReader(), FromActive)
        loop.call_later(3.7, lambda: taking.append(asyncio.create_task(link.send("a"))))
        began = loop.time()
        with pytest.raises(ReplicationError, match="sent nothing for 10 s"):
            await link.receive(SECONDS)
        return loop.time() - began

    taking: list[asyncio.Task[None]] = []
    with contextlib.closing(loop):
        waited = loop.run_until_complete(Process("control", machine).start(receive()))
    assert waited == pytest.approx(3.7 + SECONDS, abs=0.001)
