import asyncio
import os
import socket
import struct
from collections.abc import Iterator
from contextlib import suppress

import msgspec
import pytest

from appliance.channel.channel import SOON_SECONDS, Channel, ChannelClosedError, ChannelFullError
from appliance.channel.messages import Lifeline, Message, Ping, Pong, ProbeFailed, SocketKept, StateBegan

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("sockets")]

Pair = tuple[Channel, Channel]


@pytest.fixture
def pair() -> Iterator[Pair]:
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


def _copies_of(descriptor: int) -> int:
    same, copies = os.fstat(descriptor), 0
    for other in os.listdir("/proc/self/fd"):  # noqa: PTH208  of the kernel, not a folder
        with suppress(OSError):  # the descriptor of the list itself is closed
            copies += os.path.samestat(os.fstat(int(other)), same)
    return copies


def test_messages_arrive_in_order_with_their_descriptors(pair: Pair) -> None:
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
            assert isinstance(message, SocketKept)
            with socket.socket(fileno=descriptor) as sock:
                assert names[sock.getsockname()] == message.name


async def test_delayed_messages_are_sent_together(pair: Pair) -> None:
    here, there = pair
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
    await asyncio.sleep(SOON_SECONDS)  # closing the channel drops unsent messages
    assert [before, after, at_once] == [[], [Ping(1), SocketKept("first"), Ping(2)], [Ping(3), Ping(4)]]


def test_a_message_must_come_with_its_descriptors(pair: Pair) -> None:
    here, there = pair
    with pytest.raises(ValueError, match="travels with 1"):
        here.send(SocketKept("nothing"))
    body = msgspec.msgpack.encode(SocketKept("nothing"))
    os.write(here.fileno(), struct.pack(">I", len(body)) + body)
    with pytest.raises(msgspec.DecodeError, match="without its descriptors"):
        there.receive()


def test_foreign_data_is_rejected(pair: Pair) -> None:
    for frame, reason in (
        (_frame(msgspec.msgpack.encode(StateBegan(1))), "Invalid value"),
        (_frame(b"\xc1"), "malformed"),
        (
            _frame(msgspec.msgpack.encode(ProbeFailed("text")).replace(b"text", b"\xff" * 4)),
            "invalid start byte",
        ),
        (struct.pack(">I", 1001), "1000 are allowed"),
    ):
        one, other = socket.socketpair()
        end = Channel(other, Lifeline, longest=1000)
        one.send(frame)
        with one, pytest.raises(ValueError, match=reason):
            end.receive()
        end.close()


def test_a_peer_that_does_not_read_is_bounded(pair: Pair) -> None:
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


def test_the_end_of_the_peer_follows_its_last_messages(pair: Pair) -> None:
    here, there = pair
    here.send(Pong(7))
    here.close()
    assert there.receive() == [(Pong(7), ())]
    with pytest.raises(ChannelClosedError):
        there.receive()


def test_closing_closes_descriptors() -> None:
    one, other = socket.socketpair()
    here, there = Channel(one, Lifeline), Channel(other, Lifeline)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        for number in range(400):
            here.send(SocketKept(f"{number:0900}"), (listener.fileno(),))
        assert here.pending
        assert _copies_of(listener.fileno()) > 1
        here.close()
        there.close()
        assert (_copies_of(listener.fileno()), one.fileno(), other.fileno()) == (1, -1, -1)


async def test_an_attached_end_reports_a_dead_peer_once(pair: Pair) -> None:
    here, there = pair
    told: list[Message | str] = []
    ended = asyncio.Event()

    def end() -> None:
        told.append("end")
        ended.set()

    there.attach(asyncio.get_running_loop(), lambda message, _descriptors: told.append(message), end)
    here.send(Ping(1))
    here.close()
    there.send(Pong(1))  # the peer is gone, its last messages are not read yet
    await asyncio.wait_for(ended.wait(), 10)
    there.send(Pong(2))
    assert told == [Ping(1), "end"]


async def test_an_attached_end_rejects_foreign_data(pair: Pair) -> None:
    here, there = pair
    told: list[str] = []
    refused = asyncio.Event()

    def refuse(reason: str) -> None:
        told.append(reason)
        refused.set()

    there.attach(asyncio.get_running_loop(), lambda *_message: None, lambda: told.append("end"), refuse)
    os.write(here.fileno(), _frame(b"\xc1"))
    await asyncio.wait_for(refused.wait(), 10)
    assert len(told) == 1
    assert told != ["end"]
    assert not _is_open(there.fileno())


def _frame(body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + body
