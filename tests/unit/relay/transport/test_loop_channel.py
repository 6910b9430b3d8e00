import os
import socket
import struct
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from appliance.channel.channel import Channel, ChannelFullError
from appliance.channel.messages import FactWithdrawn, NodePlaced, RelayLink, UpstreamWanted
from appliance.relay.loop import QUANTUM, EventLoop
from appliance.relay.transport.loop_channel import LoopLink

pytestmark = pytest.mark.usefixtures("sockets")


class Ends:
    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        self.used = 0
        self.loop = EventLoop(lambda: self.used)
        self.received: list[Any] = []
        self.waits = False
        self.ended: list[str] = []
        self.raw = ours
        self.other = Channel(ours, RelayLink)
        self.link = LoopLink(self.loop, Channel(theirs, RelayLink), self._take, self.ended.append)

    def _take(self, message: Any, descriptors: tuple[int, ...]) -> bool:
        if self.waits:
            return True
        self.received.append(message)
        self.used += QUANTUM // 100
        for descriptor in descriptors:
            os.close(descriptor)
        return False

    def close(self) -> None:
        self.link.close()
        self.other.close()
        self.loop.close()


def send(sock: socket.socket, count: int) -> None:
    bodies = [msgspec.msgpack.encode(FactWithdrawn(("node", str(number)))) for number in range(count)]
    data = b"".join(struct.pack(">I", len(body)) + body for body in bodies)
    assert sock.send(data) == len(data)


@pytest.fixture
def ends() -> Iterator[Ends]:
    ends = Ends()
    yield ends
    ends.close()


def test_thousands_of_messages_are_carried_out_a_quantum_at_a_time_and_in_order(ends: Ends) -> None:
    """Other sockets get their turns in between: a message costs a hundredth of a quantum here."""
    send(ends.raw, 1000)
    ends.loop.turn(1)
    assert 0 < len(ends.received) <= 210
    while len(ends.received) < 1000:
        ends.loop.turn(1)
    assert [message.fact[1] for message in ends.received] == [str(number) for number in range(1000)]


def test_catch_up_carries_out_everything_that_was_sent(ends: Ends) -> None:
    send(ends.raw, 1000)
    ends.link.catch_up()
    assert len(ends.received) == 1000


def test_messages_sent_before_the_end_are_read(ends: Ends) -> None:
    send(ends.raw, 600)
    ends.other.close()
    for _ in range(4):
        ends.loop.turn(0.1)
    assert len(ends.received) == 600
    assert len(ends.ended) == 1


def test_closing_closes_descriptors_that_were_not_taken(ends: Ends) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        for number in range(40):
            ends.other.send(NodePlaced(str(number), "/n", "h"), (listening.fileno(),))
        before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - of the kernel, not a folder
        ends.link.close()
        assert len(os.listdir("/proc/self/fd")) <= before  # noqa: PTH208 - of the kernel, not a folder


def test_while_messages_wait_no_more_is_read(ends: Ends) -> None:
    ends.waits = True
    body = msgspec.msgpack.encode(FactWithdrawn(("node", "k")))
    frame, sent = struct.pack(">I", len(body)) + body, 0
    ends.raw.setblocking(False)
    with pytest.raises(BlockingIOError):
        while sent < 1 << 24:
            data = frame * 1000
            sent += ends.raw.send(data[sent % len(frame) :])
            ends.link.catch_up()
            ends.loop.turn(0)
    ends.link.send(UpstreamWanted("k", "/topic"))
    assert [message for message, _ in ends.other.receive()] == [UpstreamWanted("k", "/topic")]
    ends.other.close()
    ends.loop.turn(0)
    assert ends.received == ends.ended == []
    ends.waits = False
    ends.link.go_on()
    while not ends.ended:
        ends.loop.turn(1)
    assert len(ends.received) == sent // len(frame)
    assert len(ends.ended) == 1


def test_an_end_that_does_not_read_yet_gets_everything_later(ends: Ends) -> None:
    for number in range(20_000):
        ends.link.send(UpstreamWanted(str(number), "/topic"))
    keys: list[str] = []
    while len(keys) < 20_000:
        ends.loop.turn(0.1)
        keys += [
            message.key
            for message, _descriptors in ends.other.receive()
            if isinstance(message, UpstreamWanted)
        ]
    assert keys == [str(number) for number in range(20_000)]


def test_a_backlog_beyond_the_limit_ends_the_process_and_not_the_link_alone(ends: Ends) -> None:
    """The other end opens a link only to a new process."""
    with pytest.raises(ChannelFullError):
        ends.link.send(UpstreamWanted("k", "/" * (65 << 20)))
    assert ends.ended == []
