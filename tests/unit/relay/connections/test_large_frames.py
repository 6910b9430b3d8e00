"""Large frames in pieces: a publisher and subscribers over real sockets, in the test's own thread."""

import socket
import struct
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.channel.messages import (
    ConnectionClosed,
    FlowLimit,
    GrantInstalled,
    GrantRevoked,
    LookWanted,
    MessageSeen,
    MessagesLimited,
    PublicationPlaced,
    PublicationWithdrawn,
    TopicTraffic,
    TrafficReported,
    UpstreamLost,
)
from appliance.relay.connections.headers import size_of
from appliance.relay.connections.large_frames import PUBLISHER_GONE
from appliance.relay.relay_limits import MIB
from appliance.relay.transport.frames import LARGE, PIECE
from roswire.tcpros import encode_frame, encode_header
from tests.support.examples import examples
from tests.unit.relay.world import ASK, HEADER, LIMITS, LOOPBACK, Peer, World

HALF = 2 * MIB
FRAME = encode_frame(bytes(range(256)) * (2 * HALF // 256))
SLOW_HOST = "127.0.0.9"


@pytest.fixture
def world() -> Iterator[World]:
    """Run a relay whose sockets hold little, so that a subscriber that does not read is soon behind."""
    world = small(World(LIMITS))
    yield world
    world.close()


def small(world: World) -> World:
    """Give the relay's connections to subscribers a small send buffer."""
    world.port.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 32 << 10)
    return world


def joins(world: World, host: str = LOOPBACK) -> Peer:
    """Return one more subscriber that is served."""
    if host != LOOPBACK:
        world.state(GrantInstalled("k", "/chatter", host, "/listener"))
    peer = world.connect(encode_header(ASK), host=host)
    peer.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 32 << 10)
    assert world.gets_header(peer) == HEADER
    return peer


def subscribed(world: World) -> tuple[Peer, Peer]:
    """Return a publisher and a subscriber that is served, and that holds little that it has not read."""
    publisher, subscriber = world.subscribed()
    subscriber.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 32 << 10)
    return publisher, subscriber


def gets_part(world: World, peer: Peer, data: bytes) -> None:
    """Wait until the peer has received exactly these bytes, and keep them."""

    def whole() -> bool:
        peer.read()
        return len(peer.data) >= len(data)

    world.until(whole)
    assert peer.data == data


def held(world: World) -> int:
    """Return the bytes of messages that the relay holds, without the publisher's header."""
    return world.held - size_of(HEADER)


def traffic(world: World) -> list[int]:
    """Return the messages, bytes, drops and counted delays of all reports, the next one included."""

    def rows() -> list[list[TopicTraffic]]:
        return [message.rows for message in world.told if isinstance(message, TrafficReported)]

    before = len(rows())
    world.until(lambda: len(rows()) > before)
    all_rows = [row for part in rows() for row in part]
    return [
        sum(row.messages for row in all_rows),
        sum(row.bytes for row in all_rows),
        sum(row.dropped for row in all_rows),
        sum(sum(row.delays) for row in all_rows),
    ]


def test_a_large_frame_is_passed_on_before_it_has_arrived_and_takes_no_memory(world: World) -> None:
    """Subscribers get the first half while the second has not been sent; the frame is counted once."""
    publisher, subscriber = subscribed(world)
    world.push(publisher, FRAME[:HALF])
    gets_part(world, subscriber, FRAME[:HALF])
    assert held(world) == 0
    assert traffic(world)[0] == 0
    world.push(publisher, FRAME[HALF:])
    world.gets(subscriber, FRAME)
    assert traffic(world) == [1, len(FRAME), 0, 1]


@pytest.mark.parametrize("header", [{"latching": "1"}])
def test_a_latched_frame_is_received_whole(world: World, header: dict[str, str]) -> None:
    """The relay keeps it for later subscribers."""
    subscriber = world.connect(encode_header(ASK))
    publisher = world.upstream(HEADER | header)
    world.gets_header(subscriber)
    world.push(publisher, FRAME[:HALF])
    world.until(lambda: held(world) >= HALF - PIECE)
    subscriber.read()
    assert not subscriber.data
    world.push(publisher, FRAME[HALF:])
    world.gets(subscriber, FRAME)


def test_a_tap_during_a_frame_begins_with_the_next_one(world: World) -> None:
    """Operators see only whole messages."""
    publisher, subscriber = subscribed(world)
    world.push(publisher, FRAME[:HALF])
    gets_part(world, subscriber, FRAME[:HALF])
    world.state(LookWanted(1, "/chatter", 5, latched=False))
    world.push(publisher, FRAME[HALF:])
    world.gets(subscriber, FRAME)
    world.push(publisher, FRAME[:HALF])
    world.until(lambda: held(world) >= HALF - PIECE)
    assert not [one for one in world.told if isinstance(one, MessageSeen)]
    world.push(publisher, FRAME[HALF:])
    world.gets(subscriber, FRAME)
    assert world.hears(MessageSeen).size == len(FRAME) - 4


def test_a_rate_limit_during_a_frame_begins_with_the_next_one(world: World) -> None:
    """The frame that has begun is completed; the limit then drops messages as always."""
    publisher, subscriber = subscribed(world)
    world.push(publisher, FRAME[:HALF])
    gets_part(world, subscriber, FRAME[:HALF])
    world.state(PublicationPlaced("k", "/chatter", "*", FlowLimit(bytes=1000)))
    world.push(publisher, FRAME[HALF:])
    world.gets(subscriber, FRAME)
    world.push(publisher, FRAME + encode_frame(b"dropped"))
    world.gets(subscriber, FRAME)
    dropped = world.hears(MessagesLimited).rows[0]
    assert (dropped.part, dropped.messages) == ("publisher", 1)
    world.state(PublicationPlaced("k", "/chatter", "*"))
    world.push(publisher, encode_frame(b"on"))
    world.gets(subscriber, encode_frame(b"on"))


def test_a_subscriber_that_joins_during_a_frame_gets_the_next_one(world: World) -> None:
    """Its stream begins with a whole frame."""
    publisher, first = subscribed(world)
    world.push(publisher, FRAME[:HALF])
    gets_part(world, first, FRAME[:HALF])
    later = joins(world)
    world.push(publisher, FRAME[HALF:] + encode_frame(b"next") + FRAME)
    world.gets(first, FRAME + encode_frame(b"next") + FRAME)
    world.gets(later, encode_frame(b"next") + FRAME)


def test_a_publisher_that_dies_within_a_frame_ends_only_its_subscribers(world: World) -> None:
    """They get a reset and the report has the reason; a later subscriber stays, and is served again."""
    publisher, begun = subscribed(world)
    world.push(publisher, FRAME[:HALF])
    gets_part(world, begun, FRAME[:HALF])
    later = joins(world)
    publisher.reset()
    assert world.ends(begun) == FRAME[:HALF]
    assert world.hears(ConnectionClosed).reason == PUBLISHER_GONE
    assert world.hears(UpstreamLost).topic == "/chatter"
    again = world.upstream()
    world.push(again, FRAME)
    world.gets(later, FRAME)
    assert not later.ended


def test_a_revoked_subscriber_gets_no_further_piece(world: World) -> None:
    """Its connection ends within the frame; the other subscriber gets the frame whole."""
    publisher, stays = subscribed(world)
    revoked = joins(world, SLOW_HOST)
    world.push(publisher, FRAME[:HALF])
    for peer in (stays, revoked):
        gets_part(world, peer, FRAME[:HALF])
    world.state(GrantRevoked("k", "/chatter", SLOW_HOST, "/listener"))
    assert world.ends(revoked) == FRAME[:HALF]
    assert world.hears(ConnectionClosed).reason == "its grant is revoked"
    world.push(publisher, FRAME[HALF:] + encode_frame(b"next"))
    world.gets(stays, FRAME + encode_frame(b"next"))


def test_the_rest_of_a_frame_without_subscribers_is_skipped(world: World) -> None:
    """A subscriber that joins then begins with the next frame; the frame is counted."""
    publisher, revoked = subscribed(world)
    world.push(publisher, FRAME[:HALF])
    gets_part(world, revoked, FRAME[:HALF])
    world.state(GrantRevoked("k", "/chatter", LOOPBACK, "/listener"))
    world.ends(revoked)
    later = joins(world, SLOW_HOST)
    world.push(publisher, FRAME[HALF:] + encode_frame(b"next"))
    world.gets(later, encode_frame(b"next"))
    assert held(world) == 0


def test_a_withdrawn_topic_ends_within_a_piece(world: World) -> None:
    """No byte of the frame is passed on after the withdrawal."""
    publisher, subscriber = subscribed(world)
    world.push(publisher, FRAME[:HALF])
    gets_part(world, subscriber, FRAME[:HALF])
    world.state(PublicationWithdrawn("k", "/chatter"))
    assert world.ends(subscriber) == FRAME[:HALF]
    assert world.ends(publisher) == b""
    assert world.held == 0


def test_a_slow_subscriber_delays_no_other_and_its_frame_is_whole(world: World) -> None:
    """The fast one gets every frame; the slow one gets whole frames, the first of them in pieces."""
    publisher, fast = subscribed(world)
    slow = joins(world, SLOW_HOST)
    for _ in range(6):
        world.push(publisher, FRAME)
        world.gets(fast, FRAME)
    assert held(world) <= LIMITS.queue_bytes + 2 * len(FRAME)

    def caught_up() -> bool:
        slow.read()
        return world.engine.memory.queues.of(SLOW_HOST).used == 0

    world.until(caught_up)
    world.push(publisher, encode_frame(b"end"))
    world.until(lambda: slow.read() or slow.data.endswith(encode_frame(b"end")))  # type: ignore[func-returns-value]  # reads first
    whole, rest = divmod(len(slow.data) - len(encode_frame(b"end")), len(FRAME))
    assert (rest, 2 <= whole <= 6) == (0, True)
    assert slow.data == FRAME * whole + encode_frame(b"end")


def test_a_subscriber_that_never_reads_holds_up_its_publisher_for_a_short_time_only(world: World) -> None:
    """The publisher is paused, then read on; the unsent bytes are memory of the slow host."""
    publisher, slow = subscribed(world)
    world.push(publisher, FRAME)  # the rest that the kernel holds waits for the pause to end
    queued = world.engine.memory.queues.of(LOOPBACK)
    world.until(lambda: queued.used > len(FRAME) - MIB)
    assert queued.used <= len(FRAME)
    world.gets(slow, FRAME)
    world.until(lambda: held(world) == 0)


def test_a_frame_begins_only_if_the_slow_hosts_memory_has_room_for_it() -> None:
    """Otherwise it is received whole, and dropped if need be; no subscriber is cut for its size."""
    world = small(World(replace(LIMITS, memory_bytes=24 * MIB)))  # 6 MiB for queues, half of it for one host
    publisher, subscriber = subscribed(world)
    world.push(publisher, FRAME[:HALF])
    world.until(lambda: held(world) >= HALF - PIECE)
    subscriber.read()
    assert not subscriber.data
    world.push(publisher, FRAME[HALF:])
    world.gets(subscriber, FRAME)
    world.close()


def test_a_subscriber_whose_host_has_no_memory_left_is_cut_within_a_frame() -> None:
    """Another connection of its host takes the memory in the meantime; the report says so, and nothing stays held."""
    world = small(World(replace(LIMITS, memory_bytes=64 * MIB)))  # 16 MiB for queues, half of it for one host
    publisher, fast = subscribed(world)
    slow = joins(world, SLOW_HOST)
    world.push(publisher, FRAME[:HALF])
    gets_part(world, fast, FRAME[:HALF])
    world.engine.memory.queues.of(SLOW_HOST).add(7 * MIB)
    world.push(publisher, FRAME[HALF:])
    world.gets(fast, FRAME)
    assert "no memory left in the relay for the rest" in world.hears(ConnectionClosed).reason
    world.engine.memory.queues.of(SLOW_HOST).add(-7 * MIB)
    world.ends(slow)
    assert held(world) == 0
    world.close()


def test_many_tiny_pieces_take_no_more_memory_than_is_counted(world: World) -> None:
    """A publisher that sends a frame byte by byte to a subscriber that does not read cannot fill the relay."""
    publisher, slow = subscribed(world)
    start = len(FRAME) - 2000
    world.push(publisher, FRAME[:start])
    for number in range(start, len(FRAME)):
        world.push(publisher, FRAME[number : number + 1])
        world.loop.turn(0)
    world.gets(slow, FRAME)
    world.until(lambda: held(world) == 0)


lengths = st.one_of(st.integers(0, 300), st.integers(LARGE - 10, LARGE + 10), st.integers(0, 3 * PIECE))
actions = st.one_of(
    st.tuples(st.just("frames"), st.lists(lengths, min_size=1, max_size=4)),
    st.tuples(st.just("send"), st.integers(1, 3 * PIECE)),
    st.tuples(st.just("read"), st.integers(1, 1 << 20)),
    st.tuples(st.just("join"), st.none()),
    st.tuples(st.just("leave"), st.none()),
    st.tuples(st.just("turn"), st.none()),
)


class Crowd:
    """A publisher, one subscriber that always reads (the first), and others that read when the test wants it."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.publisher, first = subscribed(world)
        self.members = [first]
        self.frames: list[bytes] = []
        self.rest = b""
        self.left = False  # whether a subscriber has left, with drops of its own

    def frames_of(self, sizes: list[int]) -> None:
        """Let the publisher send these frames from now on."""
        for size in sizes:
            body = struct.pack("<I", len(self.frames)) + bytes([len(self.frames) % 251]) * size
            self.frames.append(encode_frame(body))
            self.rest += self.frames[-1]

    def send(self, count: int) -> None:
        """Send this number of the publisher's bytes."""
        self.world.push(self.publisher, self.rest[:count])
        self.rest = self.rest[count:]

    def do(self, action: str, given: Any) -> None:
        """Carry out one step; the first subscriber then reads everything."""
        slow = self.members[1:]
        match action:
            case "frames":
                self.frames_of(given)
            case "send":
                self.send(given)
            case "join" if len(slow) < 4:
                self.members.append(joins(self.world))
            case "leave" if slow:
                self.members.pop(1).reset()
                self.left = True
            case "read" if slow:
                reads(slow[0], given)
            case _:
                pass
        self.world.loop.turn(0)
        self.members[0].read()

    def finish(self) -> None:
        """Send what is left, and let all subscribers read it."""
        self.frames_of([0])
        self.send(len(self.rest))
        end = self.frames[-1]

        def all_have_it() -> bool:
            for member in self.members:
                member.read()
            return all(member.data.endswith(end) for member in self.members)

        self.world.until(all_have_it)


def reads(peer: Peer, count: int) -> None:
    """Read at most this number of bytes."""
    try:
        peer.data += peer.sock.recv(count)
    except BlockingIOError:
        return


def numbers(data: bytes, frames: list[bytes]) -> list[int]:
    """Return the numbers of the frames in a stream. Raises `AssertionError` if it has anything else."""
    found, position = [], 0
    while position < len(data):
        (number,) = struct.unpack_from("<I", data, position + 4)
        assert data[position : position + len(frames[number])] == frames[number]
        found.append(number)
        position += len(frames[number])
    return found


@settings(max_examples=examples(120), deadline=None)
@given(st.lists(actions, max_size=40))
def test_every_subscriber_gets_whole_frames_in_order_whatever_happens(script: list[tuple[str, Any]]) -> None:
    """The one that reads gets every frame; the others miss only frames that are reported as dropped."""
    world = small(World(replace(LIMITS, queue_messages=4, queue_bytes=MIB)))
    try:
        crowd = Crowd(world)
        for action, given_value in script:
            crowd.do(action, given_value)
        crowd.finish()
        streams = [numbers(bytes(member.data), crowd.frames) for member in crowd.members]
        assert streams[0] == [*range(len(crowd.frames))]
        assert all(stream == sorted(set(stream)) for stream in streams)
        missing = sum(stream[-1] - stream[0] + 1 - len(stream) for stream in streams)
        world.until(lambda: held(world) == 0)
        messages, size, dropped, _delays = traffic(world)
        assert (messages, size) == (len(crowd.frames), sum(map(len, crowd.frames)))
        assert dropped == missing or crowd.left
    finally:
        world.close()
