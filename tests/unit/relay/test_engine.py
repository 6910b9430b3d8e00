"""The relay as a whole, told as transcripts: control's messages, peers' bytes, and what comes back.

The engine runs in the test's own thread; every step lets the loop turn until what is awaited has happened.
"""

import contextlib
import random
import socket
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest

from appliance.channel.channel import Channel
from appliance.channel.messages import (
    ClientGranted,
    ConnectionClosed,
    ConnectionOpened,
    ConnectionRefused,
    GrantInstalled,
    GrantRevoked,
    Message,
    NodePlaced,
    NodeWithdrawn,
    PublicationPlaced,
    PublicationWithdrawn,
    RelayLink,
    ServicePlaced,
    StateBegan,
    StateEnded,
    TrafficReported,
    UpstreamFound,
    UpstreamLost,
    UpstreamRefused,
    UpstreamWanted,
)
from appliance.relay.engine import Engine
from appliance.relay.limits import MIB, Limits
from appliance.relay.links import Link
from appliance.relay.loop import Loop
from appliance.relay.upstream import Publisher
from appliance.ros.tcpros import (
    HeaderParser,
    encode_frame,
    encode_header,
    encode_service_reply,
)

LOOPBACK = "127.0.0.1"
LIMITS = replace(
    Limits(),
    message_bytes=4 * MIB,
    queue_messages=50,
    queue_bytes=8 * MIB,
    header_seconds=0.3,
    grant_seconds=0.1,
    connect_seconds=0.3,
    linger=0.2,
    farewell=0.2,
    retry_first=0.02,
    report_every=0.1,
    connections=20,
    connections_per_host=15,
)
HEADER = {
    "callerid": "/talker",
    "type": "std_msgs/String",
    "md5sum": "m",
    "latching": "0",
    "topic": "/chatter",
}
ASK = {"callerid": "/listener", "topic": "/chatter", "type": "std_msgs/String", "md5sum": "m"}
CALL = {"callerid": "/client", "service": "/mode", "md5sum": "*"}


class Peer:
    """A socket of a test that never blocks; collects what it is sent."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        self.sock = sock
        self.data = bytearray()
        self.ended = False

    def send(self, data: bytes) -> None:
        """Write without waiting for all of it."""
        self.sock.send(data)

    def read(self) -> None:
        """Take what is there."""
        while not self.ended:
            try:
                data = self.sock.recv(1 << 20)
            except BlockingIOError:
                return
            except ConnectionResetError:
                data = b""
            self.data += data
            self.ended = not data

    def header(self) -> dict[str, str] | None:
        """The header in what has come, taken off when it is whole."""
        parser = HeaderParser()
        fields = parser.feed(bytes(self.data))
        if fields is not None:
            self.data = bytearray(parser.rest)
        return fields

    def reset(self) -> None:
        """Close with a reset, as a crashed machine's kernel does."""
        self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.sock.close()


class World:
    """An engine with a control, one node `/talker` (key `k`) that publishes /chatter and offers /mode."""

    def __init__(self, limits: Limits = LIMITS) -> None:
        self.loop = Loop()
        self.engine = Engine(self.loop, limits)
        self.told: list[Any] = []
        self.open: list[socket.socket] = []
        self.publisher = self.listen()
        self.service = self.listen()
        self.port = self.listen()
        self.connect_control()
        self.state(NodePlaced("k", "/talker", LOOPBACK), self.port)
        self.state(PublicationPlaced("k", "/chatter", "*"))
        self.state(GrantInstalled("k", "/chatter", LOOPBACK, "/listener"))
        self.state(ServicePlaced("k", "/mode", LOOPBACK, self.service.getsockname()[1]))
        self.state(ClientGranted("k", "/mode", LOOPBACK))

    def connect_control(self) -> None:
        """A (new) control."""
        ours, theirs = socket.socketpair()
        self.control = Channel(ours, RelayLink)
        self.link = Link(self.loop, Channel(theirs, RelayLink), self.engine.take, lambda _reason: None)
        self.engine.attach(self.link)

    def listen(self) -> socket.socket:
        """A listening socket of the test."""
        sock = socket.create_server((LOOPBACK, 0))
        sock.setblocking(False)
        self.open.append(sock)
        return sock

    def state(self, message: Message, *sockets: socket.socket) -> None:
        """Control says something, and it is carried out."""
        self.control.send(message, tuple(sock.fileno() for sock in sockets))
        self.link.catch_up()

    def until(self, condition: Callable[[], Any], seconds: float = 10.0) -> Any:
        """Let the loop turn until the condition gives something; fails loudly."""
        deadline = time.monotonic() + seconds
        while True:
            self.loop.turn(0.01)
            self.told += [message for message, _fds in self.control.receive()]
            found = condition()
            if found:
                return found
            assert time.monotonic() < deadline, f"not within {seconds} s; control was told {self.told[-10:]}"

    def hears(self, kind: type[Message], **fields: Any) -> Any:
        """Control is told something of this kind; it is taken out of what was told."""

        def find() -> Any:
            for message in self.told:
                if isinstance(message, kind) and all(getattr(message, k) == v for k, v in fields.items()):
                    return message
            return None

        found = self.until(find)
        self.told.remove(found)
        return found

    def connect(self, *parts: bytes) -> Peer:
        """A peer at the relay's port."""
        peer = Peer(socket.create_connection((LOOPBACK, self.port.getsockname()[1])))
        self.open.append(peer.sock)
        for part in parts:
            peer.send(part)
        return peer

    def push(self, peer: Peer, data: bytes) -> None:
        """The peer sends all of this, as fast as the relay takes it."""
        rest = memoryview(data)
        while rest:
            with contextlib.suppress(BlockingIOError):
                rest = rest[peer.sock.send(rest[:MIB]) :]
            self.loop.turn(0)

    def accept(self, listening: socket.socket) -> Peer:
        """The relay's connection to the publisher or the service."""

        def take() -> Peer | None:
            try:
                return Peer(listening.accept()[0])
            except BlockingIOError:
                return None

        peer: Peer = self.until(take)
        self.open.append(peer.sock)
        return peer

    def gets_header(self, peer: Peer) -> dict[str, str]:
        """The peer has been sent a header."""

        def find() -> dict[str, str] | None:
            peer.read()
            return peer.header()

        fields: dict[str, str] = self.until(find)
        return fields

    def gets(self, peer: Peer, data: bytes) -> None:
        """The peer has been sent exactly this."""

        def whole() -> bool:
            peer.read()
            return len(peer.data) >= len(data)

        self.until(whole)
        assert peer.data == data
        peer.data.clear()

    def ends(self, peer: Peer) -> bytes:
        """The peer's connection is closed by the relay; what came before."""

        def ended() -> bool:
            peer.read()
            return peer.ended

        self.until(ended)
        return bytes(peer.data)

    def upstream(self, header: dict[str, str] = HEADER) -> Peer:
        """Answer the relay's question for the publisher, and its header."""
        self.hears(UpstreamWanted, key="k", topic="/chatter")
        self.state(UpstreamFound("k", "/chatter", LOOPBACK, self.publisher.getsockname()[1]))
        peer = self.accept(self.publisher)
        asked = self.gets_header(peer)
        assert (asked["topic"], asked["md5sum"], asked["callerid"]) == ("/chatter", "*", "/rosrv")
        peer.send(encode_header(header))
        return peer

    def subscribed(self) -> tuple[Peer, Peer]:
        """A publisher and a subscriber that is served."""
        subscriber = self.connect(encode_header(ASK))
        publisher = self.upstream()
        assert self.gets_header(subscriber) == HEADER
        return publisher, subscriber

    def close(self) -> None:
        """End everything."""
        self.engine.close()
        self.link.close()
        self.loop.close()
        self.control.close()
        for sock in self.open:
            sock.close()


@pytest.fixture
def world() -> Iterator[World]:
    """A relay with one node."""
    world = World()
    yield world
    world.close()


def test_a_subscriber_gets_the_publishers_header_and_messages(world: World) -> None:
    """And control is told of the connection, its end, and the traffic."""
    publisher, subscriber = world.subscribed()
    opened = world.hears(ConnectionOpened)
    assert opened == ConnectionOpened(opened.number, "k", "/chatter", "topic", LOOPBACK, "/listener")
    publisher.send(encode_frame(b"one") + encode_frame(b"two"))
    world.gets(subscriber, encode_frame(b"one") + encode_frame(b"two"))
    rows = world.hears(TrafficReported).rows
    assert [(row.resource, row.messages, row.bytes, row.subscribers) for row in rows] == [
        ("/chatter", 2, 14, 1)
    ]
    subscriber.sock.close()
    world.hears(ConnectionClosed, number=opened.number, reason="")


def test_messages_that_come_with_the_publishers_header_are_not_lost(world: World) -> None:
    """A latching publisher sends them in one piece."""
    subscriber = world.connect(encode_header(ASK))
    world.hears(UpstreamWanted)
    world.state(UpstreamFound("k", "/chatter", LOOPBACK, world.publisher.getsockname()[1]))
    publisher = world.accept(world.publisher)
    world.gets_header(publisher)
    publisher.send(encode_header(HEADER) + encode_frame(b"one") + encode_frame(b"two")[:3])
    publisher.send(encode_frame(b"two")[3:])
    world.gets_header(subscriber)
    world.gets(subscriber, encode_frame(b"one") + encode_frame(b"two"))


def test_a_grant_that_was_sent_before_the_peer_came_counts(world: World) -> None:
    """Even when the peer is faster than the grant: it is kept waiting for a moment."""
    peer = world.connect(encode_header(ASK | {"callerid": "/late"}))
    world.until(lambda: world.engine._waiting)
    world.control.send(GrantInstalled("k", "/chatter", LOOPBACK, "/late"))
    world.upstream()
    assert world.gets_header(peer) == HEADER
    assert not world.engine._waiting


def test_nobody_is_refused_while_control_restates(world: World) -> None:
    """A subscriber that comes between two statements of a new control is served when its grant is stated."""
    world.state(NodeWithdrawn("k"))
    world.state(StateBegan(2))
    world.state(NodePlaced("k", "/talker", LOOPBACK), world.port)
    early, stranger = (
        world.connect(encode_header(ASK)),
        world.connect(encode_header(ASK | {"callerid": "/x"})),
    )
    world.until(lambda: len(world.engine._waiting.get("k", ())) == 2)
    done = world.loop.clock() + 3 * LIMITS.grant_seconds
    world.until(lambda: world.loop.clock() > done)
    world.state(PublicationPlaced("k", "/chatter", "*"))
    world.state(GrantInstalled("k", "/chatter", LOOPBACK, "/listener"))
    world.state(StateEnded(2))
    world.upstream()
    assert world.gets_header(early) == HEADER
    assert "no grant" in world.gets_header(stranger)["error"]


def test_a_peer_that_leaves_while_it_waits_leaves_nothing(world: World) -> None:
    """Its place is free at once."""
    peer = world.connect(encode_header(ASK | {"callerid": "/late"}))
    world.until(lambda: world.engine._waiting)
    peer.sock.close()
    world.until(lambda: not world.engine._waiting and not world.engine._visitors)
    assert world.engine._ports._total == 0


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"callerid": "/x", "topic": "/chatter", "md5sum": "*"}, "no grant"),
        ({"callerid": "/listener", "topic": "/other", "md5sum": "*"}, "not a publisher"),
        ({"topic": "/chatter", "md5sum": "*"}, "Missing required 'callerid'"),
        ({"callerid": "/listener", "topic": "/chatter"}, "Missing required 'md5sum'"),
        ({"callerid": "/listener"}, "neither a topic nor a service"),
        ({"callerid": "/listener", "topic": "/chatter", "service": "/mode", "md5sum": "*"}, "one of them"),
        ({"callerid": "/x", "service": "/other", "md5sum": "*"}, "not a provider"),
        ({"callerid": "/x", "service": "/mode"}, "Missing required 'md5sum'"),
        ({}, "neither a topic nor a service"),
    ],
)
def test_who_may_not_is_told_why(world: World, fields: dict[str, str], reason: str) -> None:
    """An error header, the end of the connection, and a report."""
    peer = world.connect(encode_header(fields))
    assert reason in world.gets_header(peer)["error"]
    world.ends(peer)
    refused = world.hears(ConnectionRefused)
    assert reason in refused.reason
    assert (refused.key, refused.host, refused.count) == ("k", LOOPBACK, 1)


def test_equal_refusals_are_folded(world: World) -> None:
    """The first at once, the others with a count."""
    for peer in [world.connect(encode_header(ASK | {"callerid": "/x"})) for _ in range(5)]:
        world.ends(peer)
    counts = [world.hears(ConnectionRefused).count]
    while sum(counts) < 5:
        counts.append(world.hears(ConnectionRefused).count)
    assert sum(counts) == 5
    assert len(counts) < 5


@pytest.mark.parametrize(
    "data", [b"GET / HTTP/1.1\r\n\r\n", b"\xff\xff\xff\xff", struct.pack("<II", 8, 99) + b"junk"]
)
def test_what_is_no_header_ends_the_connection(world: World, data: bytes) -> None:
    """Whatever a stranger sends: the connection is closed and reported."""
    world.ends(world.connect(data))
    assert "header" in world.hears(ConnectionRefused).reason


def test_a_header_that_never_comes_whole_is_not_waited_for(world: World) -> None:
    """Silence and a slow drip end alike."""
    silent, slow = world.connect(), world.connect(encode_header(ASK)[:7])
    world.ends(silent)
    world.ends(slow)
    assert "did not send" in world.hears(ConnectionRefused).reason


def test_connections_have_a_bound_and_places_are_given_back(world: World) -> None:
    """A flood from one host is turned away at its bound; when it ends, the host is served again."""
    flood = [world.connect() for _ in range(LIMITS.connections_per_host + 3)]
    assert "limit for one host" in world.hears(ConnectionRefused).reason
    for peer in flood:
        peer.reset()
    world.until(lambda: not world.engine._visitors)
    world.subscribed()


def test_a_peer_that_resets_at_any_point_harms_nobody(world: World) -> None:
    """Before, in and after its header, and while it is served."""
    publisher, subscriber = world.subscribed()
    for length in (0, 1, 5, len(encode_header(ASK))):
        world.connect(encode_header(ASK)[:length]).reset()
    publisher.send(encode_frame(b"still here"))
    world.gets(subscriber, encode_frame(b"still here"))
    world.until(lambda: not world.engine._visitors)


def test_a_lost_publisher_is_found_again_and_subscribers_stay(world: World) -> None:
    """In the middle of a message: nobody sees a torn frame, control is told, and messages go on."""
    publisher, subscriber = world.subscribed()
    publisher.send(encode_frame(b"one") + encode_frame(b"x" * 1000)[:500])
    world.gets(subscriber, encode_frame(b"one"))
    publisher.sock.close()
    world.hears(UpstreamLost, key="k", topic="/chatter")
    publisher = world.upstream()
    publisher.send(encode_frame(b"two"))
    world.gets(subscriber, encode_frame(b"two"))
    assert not subscriber.ended


def test_a_publisher_that_cannot_be_reached_is_asked_for_again(world: World) -> None:
    """Refused by control, refused by the kernel, silent, or answering with an error."""
    subscriber = world.connect(encode_header(ASK))
    world.hears(UpstreamWanted)
    world.state(UpstreamRefused("k", "/chatter", "not yet"))
    closed = world.listen()
    nowhere = closed.getsockname()[1]
    closed.close()
    world.hears(UpstreamWanted)
    world.state(UpstreamFound("k", "/chatter", LOOPBACK, nowhere))
    assert not world.hears(UpstreamLost).violation
    world.hears(UpstreamWanted)
    world.state(UpstreamFound("k", "/chatter", LOOPBACK, world.publisher.getsockname()[1]))
    silent = world.accept(world.publisher)
    assert "no answer" in world.hears(UpstreamLost).reason
    world.ends(silent)
    world.upstream({"error": "not a publisher of it" + 2000 * "!"})
    refused = world.hears(UpstreamLost)
    assert "not a publisher of it" in refused.reason
    assert (len(refused.reason), refused.violation) == (1000, "connection refused")
    world.upstream({"type": "std_msgs/String"})
    assert world.hears(UpstreamLost).violation == "malformed"
    world.hears(UpstreamWanted)
    world.state(UpstreamFound("k", "/chatter", LOOPBACK, world.publisher.getsockname()[1]))
    world.accept(world.publisher).send(struct.pack("<II", 8, 100) + b"type")
    unreadable = world.hears(UpstreamLost)
    assert ("header cannot be read" in unreadable.reason, unreadable.violation) == (True, "malformed")
    world.upstream()
    assert world.gets_header(subscriber) == HEADER


def test_a_publisher_that_always_closes_is_waited_for_ever_longer_until_it_stays(world: World) -> None:
    """An answered header is no success: each try would cost a call of the node and a record, ten times a second."""
    world.connect(encode_header(ASK))
    waits = []
    for _ in range(6):
        world.upstream().sock.close()
        world.hears(UpstreamLost)
        began = time.monotonic()
        world.until(lambda: any(isinstance(one, UpstreamWanted) for one in world.told))
        waits.append(time.monotonic() - began)
    assert waits[-1] > 10 * LIMITS.retry_first
    patient = World(replace(LIMITS, retry_longest=0.05))
    patient.connect(encode_header(ASK))
    for _ in range(3):
        patient.upstream().sock.close()
        patient.hears(UpstreamLost)
    staying = patient.upstream()
    ends = time.monotonic() + 0.1
    patient.until(lambda: time.monotonic() > ends)
    ((_topic, publisher),) = patient.engine._topics.values()
    assert isinstance(publisher, Publisher)
    assert publisher._failures == 3
    staying.sock.close()
    patient.hears(UpstreamLost)
    assert publisher._failures == 1
    patient.close()


@pytest.mark.parametrize("host", ["robot.local", "", "10.0.0", "127.0.0.1\0"])
def test_a_publisher_is_only_looked_for_at_an_address(world: World, host: str) -> None:
    """A name would be looked up, and the lookup would hold everybody."""
    world.connect(encode_header(ASK))
    world.hears(UpstreamWanted)
    world.state(UpstreamFound("k", "/chatter", host, 1))
    assert "cannot connect" in world.hears(UpstreamLost).reason


def test_a_message_beyond_the_limit_cuts_the_publisher_not_the_subscriber(world: World) -> None:
    """Its connection is given up with a report; the subscriber stays for the next."""
    publisher, subscriber = world.subscribed()
    publisher.send(encode_frame(b"one") + struct.pack("<I", LIMITS.message_bytes + 1))
    world.ends(publisher)
    lost = world.hears(UpstreamLost)
    assert ("limit" in lost.reason, lost.violation) == (True, "limit exceeded")
    subscriber.read()
    assert not subscriber.ended


@pytest.mark.parametrize("seed", range(5))
def test_whatever_peers_send_the_relay_serves_on(world: World, seed: int) -> None:
    """Random bytes and broken headers from publisher, service, subscribers and clients; then a normal life."""
    chance = random.Random(seed)  # noqa: S311 - a test that can be repeated
    pieces = [encode_header(HEADER), encode_header(ASK), encode_header(CALL), encode_frame(b"x" * 300)]
    world.connect(encode_header(ASK))
    for _ in range(40):
        data = bytearray(chance.choice(pieces) * chance.randrange(1, 3))
        for _ in range(chance.randrange(4)):
            data[chance.randrange(len(data))] = chance.randrange(256)
        peer = world.connect(bytes(data[: chance.randrange(len(data) + 1)]))
        world.loop.turn(0.005)
        world.told += [message for message, _fds in world.control.receive()]
        if any(isinstance(message, UpstreamWanted) for message in world.told):
            world.state(UpstreamFound("k", "/chatter", LOOPBACK, world.publisher.getsockname()[1]))
        for listening in (world.publisher, world.service):
            with contextlib.suppress(BlockingIOError), listening.accept()[0] as sock:
                sock.setblocking(False)
                sock.send(data)
                world.loop.turn(0.005)
        chance.choice((peer.reset, peer.sock.close, lambda: None))()
    world.state(NodeWithdrawn("k"))
    world.until(lambda: not (world.engine._farewells or world.engine._visitors or world.engine._clients))
    assert world.engine._context.budget.used == 0
    assert world.engine._ports._total == 0
    world.publisher = world.listen()
    world.state(NodePlaced("k", "/talker", LOOPBACK), world.port)
    world.state(PublicationPlaced("k", "/chatter", "*"))
    world.state(GrantInstalled("k", "/chatter", LOOPBACK, "/listener"))
    world.told.clear()
    publisher, subscriber = world.subscribed()
    publisher.send(encode_frame(b"well"))
    world.gets(subscriber, encode_frame(b"well"))


def test_the_publisher_is_let_go_some_time_after_the_last_subscriber(world: World) -> None:
    """One that comes back within the linger finds the connection still there."""
    publisher, subscriber = world.subscribed()
    subscriber.sock.close()
    world.hears(ConnectionClosed)
    again = world.connect(encode_header(ASK))
    assert world.gets_header(again) == HEADER
    publisher.send(encode_frame(b"one"))
    world.gets(again, encode_frame(b"one"))
    again.sock.close()
    world.ends(publisher)


@pytest.mark.parametrize(
    "message",
    [
        GrantRevoked("k", "/chatter", LOOPBACK, "/listener"),
        PublicationWithdrawn("k", "/chatter"),
        NodeWithdrawn("k"),
    ],
    ids=lambda message: type(message).__name__,
)
def test_what_a_connection_stands_on_takes_it_along(world: World, message: Message) -> None:
    """Grant, publication and node: withdrawn means cut."""
    _publisher, subscriber = world.subscribed()
    world.hears(ConnectionOpened)
    world.state(message)
    world.ends(subscriber)
    assert world.hears(ConnectionClosed).reason


def test_a_subscriber_that_waits_for_the_header_is_cut_too(world: World) -> None:
    """Nobody waits for a publisher that is withdrawn."""
    waiting = world.connect(encode_header(ASK))
    world.hears(UpstreamWanted)
    world.state(PublicationWithdrawn("k", "/chatter"))
    world.ends(waiting)


def test_a_withdrawn_nodes_port_is_closed(world: World) -> None:
    """Who connects now is refused by the kernel once nobody else keeps the socket."""
    world.state(NodeWithdrawn("k"))
    where = world.port.getsockname()
    world.port.close()
    world.loop.turn(0.01)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(where)


def test_a_new_control_learns_what_is_open_and_open_questions_are_put_to_it(world: World) -> None:
    """Everything goes on; what it does not restate is cut at the end of its restatement."""
    publisher, subscriber = world.subscribed()
    first = world.hears(ConnectionOpened)
    world.state(PublicationPlaced("k", "/other", "*"))
    world.state(GrantInstalled("k", "/other", LOOPBACK, "/listener"))
    waiting = world.connect(encode_header(ASK | {"topic": "/other"}))
    world.hears(UpstreamWanted, topic="/other")
    world.link.close()
    world.engine.attach(None)
    publisher.send(encode_frame(b"alone"))
    world.control.close()
    world.connect_control()
    world.gets(subscriber, encode_frame(b"alone"))
    world.state(StateBegan(2))
    world.state(NodePlaced("k", "/talker", LOOPBACK), world.port)
    world.state(PublicationPlaced("k", "/chatter", "*"))
    world.state(PublicationPlaced("k", "/other", "*"))
    world.state(GrantInstalled("k", "/chatter", LOOPBACK, "/listener"))
    world.state(StateEnded(2))
    assert world.hears(ConnectionOpened) == first
    world.ends(waiting)
    publisher.send(encode_frame(b"again"))
    world.gets(subscriber, encode_frame(b"again"))


def test_a_slow_subscriber_drops_the_oldest_and_holds_nobody(world: World) -> None:
    """The quick one gets everything in order; the slow one whole messages in order, the rest is counted."""
    publisher, slow = world.subscribed()
    quick = world.connect(encode_header(ASK))
    assert world.gets_header(quick) == HEADER
    messages = [encode_frame(struct.pack("<I", number) + bytes(100_000)) for number in range(400)]
    for message in messages:
        world.push(publisher, message)
        quick.read()
    world.gets(quick, b"".join(messages))
    total = sum(map(len, messages))
    slow.read()

    def quiet() -> bool:
        before = len(slow.data)
        world.loop.turn(0.05)
        slow.read()
        return len(slow.data) == before

    world.until(quiet)
    numbers, position = [], 0
    while position < len(slow.data):
        length, number = struct.unpack_from("<II", slow.data, position)
        numbers.append(number)
        position += 4 + length
    assert position == len(slow.data) < total
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == 399
    dropped = 0
    while dropped < 400 - len(numbers):
        dropped += sum(row.dropped for row in world.hears(TrafficReported).rows)
    assert dropped == 400 - len(numbers)


def test_memory_is_given_back(world: World) -> None:
    """After slow subscribers, large messages and broken publishers nothing is counted as used."""
    publisher, slow = world.subscribed()
    rest = encode_frame(bytes(3 * MIB)) * 6 + encode_frame(bytes(3 * MIB))[:MIB]
    world.push(publisher, rest)
    world.until(lambda: world.engine._context.budget.used > MIB)
    publisher.reset()
    slow.reset()
    world.until(lambda: world.engine._context.budget.used == 0)


def test_who_begins_a_large_message_and_falls_silent_is_cut() -> None:
    """What it holds is given back: a publisher that goes on, however slowly, is waited for."""
    patient = World(replace(LIMITS, stall_seconds=0.5))
    subscriber = patient.connect(encode_header(ASK))
    publisher = patient.upstream()
    patient.gets_header(subscriber)
    message = encode_frame(bytes(MIB))
    for start in range(0, MIB, MIB // 4):
        patient.push(publisher, message[start : start + MIB // 4])
        ends = time.monotonic() + 0.2
        patient.until(lambda: time.monotonic() > ends)  # noqa: B023 - called at once
    patient.push(publisher, message[MIB:])
    patient.gets(subscriber, message)
    patient.push(publisher, message[: MIB // 2])
    lost = patient.hears(UpstreamLost)
    assert ("nothing for 0.5 s" in lost.reason, lost.violation) == (True, "limit exceeded")
    assert patient.engine._context.budget.used == 0
    client = patient.connect(encode_header(CALL))
    service = patient.accept(patient.service)
    patient.gets_header(service)
    service.send(encode_header({"callerid": "/talker", "type": "x/Y", "md5sum": "m"}))
    patient.gets_header(client)
    patient.push(client, encode_frame(bytes(3 * MIB))[: 2 * MIB])
    patient.ends(client)
    assert "nothing of it has come or gone" in patient.hears(ConnectionClosed).reason
    assert patient.engine._context.budget.used == 0
    patient.close()


def test_headers_that_are_never_finished_are_bounded_together() -> None:
    """Of a host's share: further ones are turned away, and what they held is given back."""
    world = World(replace(LIMITS, header_memory_bytes=64 << 10, header_seconds=30.0))
    unfinished = struct.pack("<I", 60_000) + bytes(20_000)
    first = world.connect(unfinished)
    world.until(lambda: world.engine._visitors)
    world.until(lambda: next(iter(world.engine._visitors))._weight == len(unfinished))
    second = world.connect(unfinished)
    world.ends(second)
    assert "unfinished" in world.hears(ConnectionRefused).reason
    first.reset()
    world.until(lambda: not world.engine._visitors)
    assert world.engine._context.headers.of(LOOPBACK).used == 0
    world.close()


def test_a_call_goes_through(world: World) -> None:
    """Headers written afresh with every field, then request and reply, then the end."""
    client = world.connect(encode_header(CALL | {"session": "7"}))
    service = world.accept(world.service)
    assert world.gets_header(service) == CALL | {"session": "7"}
    service.send(encode_header({"callerid": "/talker", "md5sum": "m", "type": "t"}))
    assert world.gets_header(client)["type"] == "t"
    client.send(encode_frame(b"ask"))
    world.gets(service, encode_frame(b"ask"))
    service.send(encode_service_reply(b"answer"))
    assert world.ends(client) == encode_service_reply(b"answer")
    world.ends(service)
    opened = world.hears(ConnectionOpened)
    assert (opened.resource, opened.kind) == ("/mode", "service")
    world.hears(ConnectionClosed, number=opened.number, reason="")


def test_a_service_that_is_silent_or_gone_is_an_error_header(world: World) -> None:
    """The caller is not left waiting for a header."""
    client = world.connect(encode_header(CALL))
    world.accept(world.service)
    assert "does not answer" in world.gets_header(client)["error"]
    client = world.connect(encode_header(CALL))
    world.accept(world.service).reset()
    assert "service" in world.gets_header(client)["error"]
    world.service.close()
    client = world.connect(encode_header(CALL))
    assert "connection to the service" in world.gets_header(client)["error"]
    world.until(lambda: not world.engine._clients)


@pytest.mark.parametrize("reply", [b"\x05abcd", encode_service_reply(b"1") * 2, b"\x01\xff\xff\xff\xff"])
def test_a_service_that_breaks_the_protocol_loses_its_client(world: World, reply: bytes) -> None:
    """Both connections are closed and nothing stays behind."""
    client = world.connect(encode_header(CALL | {"persistent": "1"}))
    service = world.accept(world.service)
    world.gets_header(service)
    service.send(encode_header({"md5sum": "m"}))
    world.gets_header(client)
    client.send(encode_frame(b""))
    world.gets(service, encode_frame(b""))
    service.send(reply)
    world.ends(service)
    world.ends(client)
    assert world.hears(ConnectionClosed).reason
    assert world.engine._context.budget.used == 0


def test_a_client_that_goes_while_the_service_works_frees_everything(world: World) -> None:
    """The service's connection ends with it."""
    client = world.connect(encode_header(CALL))
    service = world.accept(world.service)
    world.gets_header(service)
    service.send(encode_header({"md5sum": "m"}))
    world.gets_header(client)
    client.send(encode_frame(b"ask"))
    world.gets(service, encode_frame(b"ask"))
    client.sock.close()
    world.ends(service)
    world.until(lambda: not world.engine._clients)
    assert world.engine._context.budget.used == 0


def test_a_client_that_never_reads_gets_no_second_request_through(world: World) -> None:
    """Replies it does not take hold only itself."""
    client = world.connect(encode_header(CALL | {"persistent": "1"}))
    service = world.accept(world.service)
    world.gets_header(service)
    service.send(encode_header({"md5sum": "m"}))
    client.send(encode_frame(b"1") + encode_frame(b"2"))
    world.gets(service, encode_frame(b"1"))
    world.push(service, encode_service_reply(bytes(3 * MIB + MIB // 2)))
    for _ in range(20):
        world.loop.turn(0.01)
    service.read()
    second_arrived = bool(service.data)
    unread = world.engine._context.budget.used
    assert second_arrived == (unread == 0), "the second request waits while the first reply is unread"
    world.gets_header(client)
    world.gets(client, encode_service_reply(bytes(3 * MIB + MIB // 2)))
    world.gets(service, encode_frame(b"2"))
