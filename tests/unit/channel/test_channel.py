"""Tests of `appliance.channel.channel`."""

import asyncio
import os
import socket
import struct
from collections.abc import Iterator

import msgspec
import pytest

from appliance.channel.channel import SOON_SECONDS, Channel, ChannelClosedError, ChannelFullError
from appliance.channel.messages import Lifeline, Message, Ping, Pong, ProbeFailed, SocketKept, StateBegan

Pair = tuple[Channel, Channel]


@pytest.fixture
def pair() -> Iterator[Pair]:
    """Two ends of a lifeline; the second takes messages of 1,000 bytes at most."""
    one, other = socket.socketpair()
    ends = Channel(one, Lifeline, limit=300_000), Channel(other, Lifeline, longest=1000)
    yield ends
    for end in ends:
        end.close()


def _is_open(descriptor: int) -> bool:
    try:
        os.fstat(descriptor)
    except OSError:
        return False
    return True


def _open_files() -> int:
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208  only how many


def test_messages_arrive_in_order_with_their_descriptors(pair: Pair) -> None:
    """Each descriptor is delivered with the message it was sent with, also between messages without one."""
    here, there = pair
    with socket.create_server(("127.0.0.1", 0)) as first, socket.create_server(("127.0.0.1", 0)) as second:
        here.send(Ping(1))
        here.send(SocketKept("first"), (first.fileno(),))
        here.send(Ping(2))
        here.send(SocketKept("second"), (second.fileno(),))
        names = {sock.getsockname(): name for sock, name in ((first, "first"), (second, "second"))}
        received = there.receive()
    assert [message for message, _descriptors in received] == [
        Ping(1), SocketKept("first"), Ping(2), SocketKept("second"),
    ]  # fmt: skip
    for message, descriptors in received:
        for descriptor in descriptors:
            with socket.socket(fileno=descriptor) as sock:
                assert names[sock.getsockname()] == message.name


def test_what_is_sent_soon_leaves_together_and_before_what_is_not(pair: Pair) -> None:
    """It waits some milliseconds, or for the next message that does not; order and descriptors stay."""
    here, there = pair

    async def scene() -> list[list[Message]]:
        here.attach(asyncio.get_running_loop(), lambda _message, _descriptors: None, lambda: None)

        def seen() -> list[Message]:
            return [message for message, _descriptors in there.receive()]

        with socket.create_server(("127.0.0.1", 0)) as sock:
            here.send(Ping(1), soon=True)
            here.send(SocketKept("first"), (sock.fileno(),), soon=True)
            here.send(Ping(2), soon=True)
        await asyncio.sleep(0)
        before = seen()
        await asyncio.sleep(SOON_SECONDS)  # a timer that is set later ends later
        after = seen()
        here.send(Ping(3), soon=True)
        here.send(Ping(4))
        at_once = seen()
        here.send(Ping(5), soon=True)
        here.close()
        await asyncio.sleep(SOON_SECONDS)  # what was not written is given up with the channel
        return [before, after, at_once]

    assert asyncio.run(scene()) == [[], [Ping(1), SocketKept("first"), Ping(2)], [Ping(3), Ping(4)]]


def test_a_message_must_come_with_its_descriptors(pair: Pair) -> None:
    """Who sends too many or too few is told at once; who receives too few refuses the link."""
    here, there = pair
    with pytest.raises(ValueError, match="travels with 1"):
        here.send(SocketKept("nothing"))
    body = msgspec.msgpack.encode(SocketKept("nothing"))
    os.write(here.fileno(), struct.pack(">I", len(body)) + body)
    with pytest.raises(msgspec.DecodeError, match="without its descriptors"):
        there.receive()


def test_what_is_not_of_the_link_is_refused(pair: Pair) -> None:
    """A message of another link, nonsense, and one that is too long (before it is there) are errors."""
    for frame, reason in (
        (_frame(msgspec.msgpack.encode(StateBegan(1))), "Invalid value"),
        (_frame(b"\xc1"), "malformed"),
        (struct.pack(">I", 1001), "1000 are allowed"),
    ):
        one, other = socket.socketpair()
        end = Channel(other, Lifeline, longest=1000)
        one.send(frame)
        with one, pytest.raises(msgspec.DecodeError, match=reason):
            end.receive()
        end.close()


def test_a_peer_that_does_not_read_is_bounded(pair: Pair) -> None:
    """Past the limit `send` raises; what was queued before still arrives."""
    here, there = pair
    sent = 0
    with pytest.raises(ChannelFullError):
        for _ in range(10_000):
            here.send(ProbeFailed("x" * 900))
            sent += 1
    received = 0
    while received < sent:
        received += len(there.receive())
        here.flush()
    assert received == sent


def test_the_end_of_the_peer_is_told_after_its_last_words(pair: Pair) -> None:
    """What was sent before the other end closed is delivered first."""
    here, there = pair
    here.send(Pong(7))
    here.close()
    assert there.receive() == [(Pong(7), ())]
    with pytest.raises(ChannelClosedError):
        there.receive()


def test_nothing_stays_open_behind_a_closed_end() -> None:
    """Descriptors that were not sent yet, or that nobody took, are closed with the channel."""
    before = _open_files()
    one, other = socket.socketpair()
    here, there = Channel(one, Lifeline), Channel(other, Lifeline)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        for number in range(400):
            here.send(SocketKept(f"{number:0900}"), (listener.fileno(),))
    assert here.pending
    here.close()
    there.close()
    assert _open_files() == before


def test_an_attached_end_is_told_once_and_sends_without_raising(pair: Pair) -> None:
    """In an asyncio process a dead peer is one event, in order; `send` after it is nothing, not an error."""
    here, there = pair
    told: list[Message | str] = []

    async def scene() -> None:
        ended = asyncio.Event()

        def end() -> None:
            told.append("end")
            ended.set()

        there.attach(asyncio.get_running_loop(), lambda message, _descriptors: told.append(message), end)
        here.send(Ping(1))
        here.close()
        there.send(Pong(1))  # the peer is gone already, its last words are not read yet
        await asyncio.wait_for(ended.wait(), 10)
        there.send(Pong(2))

    asyncio.run(scene())
    assert told == [Ping(1), "end"]


def test_an_attached_end_refuses_what_is_not_of_its_link(pair: Pair) -> None:
    """The reason is told, the end is closed, and the loop goes on."""
    here, there = pair
    told: list[str] = []

    async def scene() -> None:
        refused = asyncio.Event()

        def refuse(reason: str) -> None:
            told.append(reason)
            refused.set()

        there.attach(asyncio.get_running_loop(), lambda *_message: None, lambda: told.append("end"), refuse)
        os.write(here.fileno(), _frame(b"\xc1"))
        await asyncio.wait_for(refused.wait(), 10)

    asyncio.run(scene())
    assert len(told) == 1
    assert told != ["end"]
    assert not _is_open(there.fileno())


def _frame(body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + body
