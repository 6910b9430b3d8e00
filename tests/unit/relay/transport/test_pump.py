import errno
import select
import socket
import struct
import time
from collections.abc import Iterator

import pytest

from appliance.relay.transport.frames import LARGE, SMALL, Scratch
from appliance.relay.transport.pump import (
    RECEIVED,
    SENT,
    SUBSCRIBERS,
    UNARMED,
    Left,
    Pump,
    Traffic,
    Version,
)

pytestmark = pytest.mark.usefixtures("sockets")

READ = select.EPOLLIN
MAX = 4096  # frames of a step
_ROOM = 64


def frame(body: bytes) -> bytes:
    return struct.pack("<I", len(body)) + body


class PlainTopic:
    def __init__(self) -> None:
        self.plain = Version()
        self.counters = Traffic()
        self.keeps_large = True


class Pumped:
    def __init__(self, subscribers: int = 1) -> None:
        self.epoll = select.epoll()
        self.pump = Pump(self.epoll.fileno())
        self.topic, self.scratch = PlainTopic(), Scratch(self.pump)
        self.pairs = [socket.socketpair() for _ in range(subscribers + 1)]
        for pair in self.pairs:
            for sock in pair:
                sock.setblocking(False)
        self.publisher, self.ours = self.pairs[0]
        self.connection = self.pump.connection()
        self.epoll.register(self.ours.fileno(), READ)
        self.pump.put(self.ours.fileno(), self.connection)
        self.arm()

    def arm(self, torn: bytes = b"") -> None:
        ours = [pair[0].fileno() for pair in self.pairs[1:]]
        self.connection.arm(self.ours.fileno(), self.topic, ours, None, torn)

    def wait(self, longest: float = 0.0) -> list[tuple[int, int]]:
        return self.pump.wait(longest, _ROOM, True)

    def pass_all(self) -> None:
        """Perform a step that leaves nothing. On a busy machine the step can be slow; `wait` then also returns it."""
        if self.wait():
            assert self.connection.step() is None

    def left(self) -> Left | None:
        found = self.wait(10)
        assert found == [(self.ours.fileno(), READ)]
        return self.connection.step()

    def received(self, number: int = 0) -> bytes:
        try:
            return self.pairs[number + 1][1].recv(1 << 20)
        except BlockingIOError:
            return b""

    def close(self) -> None:
        self.epoll.close()
        for pair in self.pairs:
            for sock in pair:
                sock.close()


@pytest.fixture
def pumped() -> Iterator[Pumped]:
    pumped = Pumped()
    yield pumped
    pumped.close()


def test_whole_frames_pass_without_python(pumped: Pumped) -> None:
    data = frame(b"one") + frame(b"") + frame(b"three")
    pumped.publisher.send(data)
    pumped.pass_all()
    assert pumped.received() == data
    messages, size, counts, seconds = pumped.topic.counters.take()
    assert (messages, size, sum(counts)) == (3, len(data), 3)
    assert 0 < seconds < 10
    assert pumped.topic.counters.following == 4
    assert pumped.topic.counters.take() == (0, 0, [], 0.0)


def test_each_subscriber_gets_every_frame() -> None:
    pumped = Pumped(SUBSCRIBERS)
    pumped.publisher.send(frame(b"x"))
    pumped.wait()
    assert [pumped.received(number) for number in range(SUBSCRIBERS)] == [frame(b"x")] * SUBSCRIBERS
    with pytest.raises(ValueError, match="17 subscribers"):
        pumped.connection.arm(
            pumped.ours.fileno(), pumped.topic, [pumped.ours.fileno()] * (SUBSCRIBERS + 1), None, b""
        )
    pumped.close()


def test_without_subscribers_messages_are_counted(pumped: Pumped) -> None:
    pumped.connection.arm(pumped.ours.fileno(), pumped.topic, [], None, b"")
    pumped.publisher.send(frame(b"x"))
    pumped.wait()
    assert pumped.topic.counters.take() == (1, 5, [], 0.0)


@pytest.mark.parametrize("cut", [1, 3, 4, 6, 8])
def test_an_incomplete_frame_waits_for_its_rest(pumped: Pumped, cut: int) -> None:
    before, torn = frame(b"before"), frame(b"torn!")
    pumped.publisher.send(before + torn[:cut])
    pumped.wait()
    assert pumped.received() == before
    pumped.publisher.send(torn[cut:])
    pumped.wait()
    assert pumped.received() == torn
    assert pumped.connection.disarm() == b""


def test_disarming_returns_the_incomplete_frame_and_arming_takes_it(pumped: Pumped) -> None:
    pumped.publisher.send(frame(b"torn!")[:6])
    pumped.wait()
    assert pumped.connection.disarm() == frame(b"torn!")[:6]
    assert pumped.connection.step() == Left(UNARMED)
    pumped.arm(b"\x03\x00")
    pumped.publisher.send(b"\x00\x00abc")
    pumped.wait()
    assert pumped.received() == frame(b"abc")
    with pytest.raises(ValueError, match="4097 bytes"):
        pumped.arm(bytes(SMALL + 1))


@pytest.mark.parametrize(
    "data",
    [
        struct.pack("<I", LARGE - 3) + b"begin",
        struct.pack("<I", 0xFFFFFFFF),
        frame(bytes(SMALL + 1))[:-1],
        frame(b"") * (MAX + 1),
        frame(b"small") + struct.pack("<I", LARGE) + b"begin",
    ],
    ids=["large", "largest", "long rest", "too many", "large second"],
)
def test_other_frames_are_left_to_python_unread(pumped: Pumped, data: bytes) -> None:
    pumped.publisher.send(data)
    assert pumped.left() == Left(RECEIVED, len(data))
    assert bytes(pumped.scratch.area[: len(data)]) == data
    assert pumped.received() == b""
    assert pumped.topic.counters.messages == 0
    assert pumped.connection.disarm() == b""


def test_a_rest_that_python_must_take_includes_its_beginning(pumped: Pumped) -> None:
    data = struct.pack("<I", LARGE)
    pumped.publisher.send(data[:2])
    pumped.wait()
    pumped.publisher.send(data[2:] + b"xy")
    assert pumped.left() == Left(RECEIVED, 6)
    assert bytes(pumped.scratch.area[:6]) == data + b"xy"


def test_a_large_batch_passes_only_while_its_rest_could_be_kept(pumped: Pumped) -> None:
    pumped.ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    pumped.publisher.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
    pumped.pairs[1][0].setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
    data = frame(bytes(4092)) * 40
    assert pumped.publisher.send(data) == len(data) > LARGE
    pumped.pass_all()
    assert pumped.received() == data
    pumped.topic.keeps_large = False
    pumped.publisher.send(data)
    assert pumped.left() == Left(RECEIVED, len(data))


def test_the_end_and_errors_of_a_publisher_are_left(pumped: Pumped) -> None:
    pumped.publisher.close()
    found = pumped.wait(10)
    assert found[0][0] == pumped.ours.fileno()
    assert pumped.connection.step() == Left(RECEIVED, 0)
    pumped.arm()
    pumped.ours.close()
    assert pumped.connection.step() == Left(RECEIVED, -errno.EBADF)


def test_a_subscriber_that_takes_a_part_is_left_with_the_later_ones() -> None:
    pumped = Pumped(3)
    slow = pumped.pairs[2][0]
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    data = frame(bytes(60_000))
    pumped.publisher.send(data)
    left = pumped.left()
    assert left is not None
    assert (left.kind, left.end, left.size, left.messages, left.number) == (
        SENT,
        len(data),
        len(data),
        1,
        1,
    )
    assert pumped.received(0) == data
    assert pumped.received(2) == b""
    if left.sent >= 0:
        assert pumped.received(1) == data[: left.sent]
    else:
        assert left.sent == -errno.EAGAIN
    assert pumped.topic.counters.messages == 0
    pumped.close()


@pytest.mark.nightly
def test_the_rest_of_a_step_says_when_it_began() -> None:
    pumped = Pumped(2)
    pumped.pairs[1][1].close()
    pumped.publisher.send(frame(b"x"))
    left = pumped.left()
    assert left is not None
    assert 0 <= time.monotonic() - left.since < 10
    pumped.close()


def test_a_subscriber_that_is_gone_is_an_error_number() -> None:
    pumped = Pumped(2)
    pumped.pairs[1][1].close()
    pumped.publisher.send(frame(b"x") + b"\x02")
    left = pumped.left()
    assert left is not None
    assert left[:4] == (SENT, 6, 5, 1)
    assert (left.number, left.sent) == (0, -errno.EPIPE)
    pumped.close()


def test_after_a_change_python_gets_the_event(pumped: Pumped) -> None:
    pumped.topic.plain.change()
    pumped.publisher.send(frame(b"x"))
    assert pumped.left() == Left(UNARMED)
    assert pumped.ours.recv(100) == frame(b"x")


def test_several_ready_descriptors_are_left_to_python(pumped: Pumped) -> None:
    ours, theirs = socket.socketpair()
    pumped.epoll.register(ours.fileno(), READ)
    theirs.send(b"x")
    pumped.publisher.send(frame(b"x"))
    assert sorted(pumped.wait(10)) == sorted([(ours.fileno(), READ), (pumped.ours.fileno(), READ)])
    assert pumped.received() == b""
    assert pumped.connection.step() is None
    assert pumped.received() == frame(b"x")
    assert ours.recv(1) == b"x"
    pumped.publisher.send(frame(b"y"))
    assert pumped.pump.wait(10, _ROOM, False) == [(pumped.ours.fileno(), READ)]
    ours.close()
    theirs.close()


def test_a_flood_does_not_delay_a_timer(pumped: Pumped) -> None:
    pumped.pump.put(pumped.ours.fileno(), None)
    endless, ours = socket.socketpair()
    endless.send(frame(b"x") * 1000)
    pumped.epoll.unregister(pumped.ours.fileno())
    pump = Pump(pumped.epoll.fileno())
    Scratch(pump).move(memoryview(bytearray(2 * SMALL)))
    connection = pump.connection()
    connection.arm(ours.fileno(), pumped.topic, [], None, b"")
    pumped.epoll.register(ours.fileno(), READ)
    pump.put(ours.fileno(), connection)
    if pump.wait(0.0, _ROOM, True):  # the step took long
        assert connection.step() is None
    assert pumped.topic.counters.messages == 1000
    endless.close()
    ours.close()


def test_a_connection_in_a_crowd_is_pumped_if_it_is_ready_alone(pumped: Pumped) -> None:
    crowd = select.epoll()
    pumped.epoll.unregister(pumped.ours.fileno())
    crowd.register(pumped.ours.fileno(), READ)
    other, theirs = socket.socketpair()
    crowd.register(other.fileno(), READ)
    pumped.epoll.register(crowd.fileno(), READ)
    pumped.pump.crowd(crowd.fileno())
    pumped.publisher.send(frame(b"x"))
    pumped.pass_all()
    assert pumped.received() == frame(b"x")
    pumped.topic.plain.change()
    pumped.publisher.send(frame(b"x"))
    assert pumped.wait(10) == [(crowd.fileno(), READ)]
    pumped.arm()
    theirs.send(b"x")
    assert pumped.wait(10) == [(crowd.fileno(), READ)]
    assert pumped.received() == b""
    for each in (crowd, other, theirs):
        each.close()


def test_a_scratch_area_may_be_replaced_between_two_reads(pumped: Pumped) -> None:
    pumped.publisher.send(frame(b"torn")[:5])
    pumped.wait()
    pumped.scratch.move(memoryview(bytearray(b"\xff" * 4 * SMALL)))
    pumped.publisher.send(frame(b"torn")[5:])
    pumped.wait()
    assert pumped.received() == frame(b"torn")
    with pytest.raises(ValueError, match="too small"):
        pumped.scratch.move(memoryview(bytearray(SMALL)))


def test_a_descriptor_without_a_connection_is_returned(pumped: Pumped) -> None:
    pumped.pump.put(pumped.ours.fileno(), None)
    pumped.pump.put(100_000, None)
    pumped.publisher.send(frame(b"x"))
    assert pumped.wait(10) == [(pumped.ours.fileno(), READ)]
    pumped.epoll.close()
    with pytest.raises(OSError, match="epoll_wait"):
        pumped.wait()
