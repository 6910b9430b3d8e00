"""The whole relay as transcripts: control's messages, the peers' bytes, and the answers."""

import contextlib
import random
import socket
import struct
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from appliance.base import clock
from appliance.channel.messages import (
    UNLIMITED,
    ClientGranted,
    ConnectionClosed,
    ConnectionOpened,
    ConnectionRefused,
    FactWithdrawn,
    FlowLimit,
    GrantInstalled,
    LimitedRow,
    Message,
    MessagesLimited,
    NodePlaced,
    OrdersAsked,
    OrdersCarriedOut,
    PublicationPlaced,
    ServicePlaced,
    StateBegan,
    StateEnded,
    TrafficReported,
    UpstreamFound,
    UpstreamLost,
    UpstreamRefused,
    UpstreamWanted,
)
from appliance.relay.connections.admission import missing
from appliance.relay.connections.upstream import PublisherConnection, UpstreamState
from appliance.relay.grant_table import GrantTable
from appliance.relay.loop import EventLoop
from appliance.relay.relay_limits import MIB
from appliance.relay.transport.frames import Batch
from roswire.tcpros import (
    encode_frame,
    encode_header,
    encode_service_reply,
)
from tests.support.steps import steps
from tests.unit.relay.dialogue import Dialogue
from tests.unit.relay.world import ASK, CALL, HEADER, IMPATIENT, LIMITS, LOOPBACK, UNHURRIED, Peer, World
from tests.unit.transcripts import transcripts

pytestmark = pytest.mark.usefixtures("sockets")

impatient = pytest.mark.parametrize("world", [IMPATIENT], indirect=True)


DIALOGUES = transcripts(Path(__file__).with_name("dialogues.txt"))


@pytest.mark.parametrize("title", DIALOGUES, ids=DIALOGUES)
def test_dialogue(title: str) -> None:
    limits = {"(impatient)": IMPATIENT, "(unhurried)": UNHURRIED}.get(title.rpartition(" ")[2], LIMITS)
    world = World(limits)
    try:
        dialogue = Dialogue(world)
        for line in DIALOGUES[title]:
            dialogue.say(line)
    finally:
        world.close()


@pytest.fixture
def world(request: pytest.FixtureRequest) -> Iterator[World]:
    world = World(getattr(request, "param", LIMITS))
    yield world
    world.close()


def test_control_gets_confirmations_of_its_orders(world: World) -> None:
    publisher, subscriber = world.subscribed()
    publisher.send(encode_frame(b"one"))
    world.gets(subscriber, encode_frame(b"one"))
    world.control.send(FactWithdrawn(("grant", "k", "/chatter", LOOPBACK, "/listener")))
    world.control.send(OrdersAsked())
    world.hears(OrdersCarriedOut)
    publisher.send(encode_frame(b"two"))
    assert subscriber.sock.recv(100) == b""


def test_a_grant_costs_the_same_among_thousands() -> None:
    def work(many: int) -> int:
        world = World(replace(LIMITS, connections=100, connections_per_host=100))
        try:
            names = [f"/listener_{number}" for number in range(many)]
            grants = [GrantInstalled("k", "/chatter", LOOPBACK, name) for name in names]
            for grant in grants:
                world.state(grant)
            topic = world.engine.topics["k", "/chatter"]
            peers: list[Peer] = []
            for name in names:
                peers.append(world.connect(encode_header(ASK | {"callerid": name})))
                world.until(lambda: len(topic.members) == len(peers))
            revoked = FactWithdrawn(("grant", "k", "/chatter", LOOPBACK, names[0]))

            def again_and_back() -> None:
                world.engine.take(grants[0], ())
                world.engine.take(revoked, ())

            done = steps(again_and_back)
            assert world.ends(peers[0]) == b""
            assert len(topic.members) == many - 1
            return done
        finally:
            world.close()

    assert work(70) < work(10) + 60


def test_messages_that_come_with_the_publishers_header_are_not_lost(world: World) -> None:
    subscriber = world.connect(encode_header(ASK))
    publisher = world.upstream(behind=encode_frame(b"one") + encode_frame(b"two")[:3])
    publisher.send(encode_frame(b"two")[3:])
    world.gets_header(subscriber)
    world.gets(subscriber, encode_frame(b"one") + encode_frame(b"two"))


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
@impatient
def test_a_denied_peer_gets_the_reason(world: World, fields: dict[str, str], reason: str) -> None:
    peer = world.connect(encode_header(fields))
    assert reason in world.gets_header(peer)["error"]
    world.ends(peer)
    refused = world.hears(ConnectionRefused)
    assert reason in refused.reason
    assert (refused.key, refused.host, refused.count) == ("k", LOOPBACK, 1)


@impatient
def test_equal_refusals_are_folded(world: World) -> None:
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
def test_an_invalid_header_ends_the_connection(world: World, data: bytes) -> None:
    world.ends(world.connect(data))
    assert "header" in world.hears(ConnectionRefused).reason


@impatient
def test_a_header_that_never_comes_whole_is_not_waited_for(world: World) -> None:
    silent, slow = world.connect(), world.connect(encode_header(ASK)[:7])
    world.ends(silent)
    world.ends(slow)
    assert "did not send" in world.hears(ConnectionRefused).reason


def test_connections_have_a_bound_and_places_are_given_back(world: World) -> None:
    flood = [world.connect() for _ in range(LIMITS.connections_per_host + 3)]
    assert "the quota of one host is 15" in world.hears(ConnectionRefused).reason
    for peer in flood:
        peer.reset()
    world.until(lambda: not world.engine.incoming_connections)
    world.subscribed()


def test_a_peer_that_resets_at_any_point_does_no_harm(world: World) -> None:
    publisher, subscriber = world.subscribed()
    for length in (0, 1, 5, len(encode_header(ASK))):
        world.connect(encode_header(ASK)[:length]).reset()
    publisher.send(encode_frame(b"still here"))
    world.gets(subscriber, encode_frame(b"still here"))
    world.until(lambda: not world.engine.incoming_connections)


@impatient
def test_a_publisher_that_cannot_be_reached_is_asked_for_again(world: World) -> None:
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
    for md5sum in ("*", ASK["md5sum"], "*"):
        world.upstream({"error": "not a publisher of it" + 2000 * "!"}, md5sum)
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
    """Otherwise the relay would reconnect ten times a second to a publisher that answers and closes."""
    world.connect(encode_header(ASK))
    waits = []
    for _ in range(6):
        world.upstream().sock.close()
        world.hears(UpstreamLost)
        began = clock.now()
        world.until(lambda: any(isinstance(one, UpstreamWanted) for one in world.told))
        waits.append(clock.now() - began)
    assert waits[-1] > 10 * LIMITS.retry_first
    patient = World(replace(LIMITS, retry_first=0.001, retry_longest=1.0))
    patient.connect(encode_header(ASK))
    for _ in range(3):
        patient.upstream().sock.close()
        patient.hears(UpstreamLost)
    staying = patient.upstream()
    (topic,) = patient.engine.topics.values()
    publisher = topic.upstream
    patient.until(lambda: topic.header is not None)
    ends = clock.now() + 1.2
    patient.until(lambda: clock.now() > ends)
    assert isinstance(publisher, PublisherConnection)
    assert publisher.failures == 3
    staying.sock.close()
    patient.hears(UpstreamLost)
    assert publisher.failures == 1
    patient.close()


@pytest.mark.parametrize("host", ["robot.local", "", "10.0.0", "127.0.0.1\0"])
def test_a_publisher_is_only_looked_for_at_an_address(world: World, host: str) -> None:
    """A name lookup would block all peers."""
    world.connect(encode_header(ASK))
    world.hears(UpstreamWanted)
    world.state(UpstreamFound("k", "/chatter", host, 1))
    assert "cannot connect" in world.hears(UpstreamLost).reason


def test_a_message_beyond_the_limit_cuts_the_publisher_not_the_subscriber(world: World) -> None:
    publisher, subscriber = world.subscribed()
    publisher.send(encode_frame(b"one") + struct.pack("<I", LIMITS.message_bytes + 1))
    world.ends(publisher)
    lost = world.hears(UpstreamLost)
    assert ("limit" in lost.reason, lost.violation) == (True, "limit exceeded")
    subscriber.read()
    assert not subscriber.ended


@pytest.mark.parametrize("seed", range(5))
def test_whatever_peers_send_the_relay_serves_on(world: World, seed: int) -> None:
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
    world.state(FactWithdrawn(("node", "k")))
    world.until(
        lambda: (
            not (
                world.engine.refused_connections or world.engine.incoming_connections or world.engine.clients
            )
        )
    )
    assert world.held == 0
    assert world.engine.ports.connected.total == 0
    world.publisher = world.listen()
    world.state(NodePlaced("k", "/talker", LOOPBACK), world.port)
    world.state(PublicationPlaced("k", "/chatter", "*"))
    world.state(GrantInstalled("k", "/chatter", LOOPBACK, "/listener"))
    world.told.clear()
    publisher, subscriber = world.subscribed()
    publisher.send(encode_frame(b"well"))
    world.gets(subscriber, encode_frame(b"well"))


@pytest.mark.parametrize(
    "message",
    [
        FactWithdrawn(("grant", "k", "/chatter", LOOPBACK, "/listener")),
        FactWithdrawn(("publication", "k", "/chatter")),
        FactWithdrawn(("node", "k")),
    ],
    ids=lambda message: message.fact[0],
)
def test_a_connection_ends_with_its_grant_publication_or_node(world: World, message: Message) -> None:
    _publisher, subscriber = world.subscribed()
    world.hears(ConnectionOpened)
    world.state(message)
    world.ends(subscriber)
    assert world.hears(ConnectionClosed).reason


def test_no_message_of_a_silent_publisher_passes(world: World) -> None:
    publisher, subscriber = world.subscribed()
    publisher.send(encode_frame(b"before"))
    world.gets(subscriber, encode_frame(b"before"))
    publisher.send(encode_frame(b"late"))
    world.state(PublicationPlaced("k", "/chatter", "*", silent=True))
    world.ends(publisher)
    world.state(GrantInstalled("k", "/chatter", LOOPBACK, "/other"))
    other = world.connect(encode_header(ASK | {"callerid": "/other"}))
    world.state(StateBegan(2))
    world.state(NodePlaced("k", "/talker", LOOPBACK), world.port)
    world.state(PublicationPlaced("k", "/chatter", "*", silent=True))
    for name in ("/listener", "/other"):
        world.state(GrantInstalled("k", "/chatter", LOOPBACK, name))
    world.state(StateEnded(2))
    world.engine.topics["k", "/chatter"].upstream.request_latched()
    world.loop.turn(0.05)
    world.told += [message for message, _fds in world.control.receive()]
    assert not any(isinstance(message, UpstreamWanted) for message in world.told)
    assert subscriber.data == other.data == b""
    world.state(PublicationPlaced("k", "/chatter", "*"))
    again = world.upstream()
    assert world.gets_header(other) == HEADER
    again.send(encode_frame(b"after"))
    for one in (subscriber, other):
        world.gets(one, encode_frame(b"after"))


def test_a_publisher_whose_silence_ends_a_right_is_connected_without_a_subscriber(world: World) -> None:
    """Once it may command, and until its silence ends nothing."""
    world.state(PublicationPlaced("k", "/cmd_vel", "*", wanted=True, silent=True))
    world.loop.turn(0.05)
    world.told += [message for message, _fds in world.control.receive()]
    assert not any(isinstance(message, UpstreamWanted) for message in world.told)
    world.state(PublicationPlaced("k", "/cmd_vel", "*", wanted=True))
    world.hears(UpstreamWanted, topic="/cmd_vel")
    upstream = world.engine.topics["k", "/cmd_vel"].upstream
    assert isinstance(upstream, PublisherConnection)
    world.state(PublicationPlaced("k", "/cmd_vel", "*"))
    world.until(lambda: upstream.state is UpstreamState.IDLE)


def test_a_withdrawn_nodes_port_is_closed(world: World) -> None:
    world.state(FactWithdrawn(("node", "k")))
    where = world.port.getsockname()
    world.port.close()
    world.loop.turn(0.01)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(where)


def test_a_new_control_learns_what_is_open_and_open_questions_are_put_to_it(world: World) -> None:
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


def test_a_slow_subscriber_drops_the_oldest_and_delays_no_other(world: World) -> None:
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
    publisher, slow = world.subscribed()
    rest = encode_frame(bytes(3 * MIB)) * 6 + encode_frame(bytes(3 * MIB))[:MIB]
    world.push(publisher, rest)
    world.until(lambda: world.held > MIB)
    publisher.reset()
    slow.reset()
    world.until(lambda: world.held == 0)


def test_a_publisher_that_stalls_in_a_large_message_is_cut() -> None:
    patient = World(replace(LIMITS, stall_seconds=1.0))
    publisher, subscriber = patient.subscribed()
    message = encode_frame(bytes(MIB))
    for start in range(0, MIB, MIB // 4):
        patient.push(publisher, message[start : start + MIB // 4])
        ends = clock.now() + 0.4
        patient.until(lambda: clock.now() > ends)  # noqa: B023 - called at once
    patient.push(publisher, message[MIB:])
    patient.gets(subscriber, message)
    patient.push(publisher, message[: MIB // 2])
    lost = patient.hears(UpstreamLost)
    assert ("no data for 1 s" in lost.reason, lost.violation) == (True, "limit exceeded")
    assert patient.held == 0
    client, _service = patient.call()
    patient.push(client, encode_frame(bytes(3 * MIB))[: 2 * MIB])
    patient.ends(client)
    assert "without progress" in patient.hears(ConnectionClosed).reason
    assert patient.held == 0
    patient.close()


def test_a_long_header_that_is_never_finished_gives_back_what_it_held() -> None:
    world = World(replace(LIMITS, header_seconds=30.0))
    unfinished = struct.pack("<I", 60_000) + bytes(20_000)
    first = world.connect(unfinished)
    world.until(lambda: world.engine.memory.headers.of(LOOPBACK).used == len(unfinished) - 4096)
    first.reset()
    world.until(lambda: not world.engine.incoming_connections)
    assert world.engine.memory.headers.of(LOOPBACK).used == 0
    world.close()


def test_unknown_hosts_make_room_for_each_other_and_never_fill_the_relay() -> None:
    world = World(replace(LIMITS, connections=40, connections_per_host=15, header_seconds=30.0))
    unknown = [world.connect(host=f"127.0.1.{number}") for number in range(1, 31)]
    for peer in unknown[:25]:
        world.ends(peer)
    assert world.engine.ports.connected.total == 5
    assert not any(peer.ended for peer in unknown[-5:])
    world.subscribed()
    world.close()


def test_the_host_with_most_makes_room_for_one_with_less() -> None:
    world = World(replace(LIMITS, connections=10, connections_per_host=10))
    greedy, other = "127.0.0.2", "127.0.0.3"
    for host in (greedy, other):
        world.state(GrantInstalled("k", "/chatter", host, "/listener"))
    first = world.connect(encode_header(ASK), host=greedy)
    publisher = world.upstream()
    world.gets_header(first)
    for _ in range(9):
        world.gets_header(world.connect(encode_header(ASK), host=greedy))
    for _ in range(5):
        world.gets_header(world.connect(encode_header(ASK), host=other))
    pool = world.engine.ports.connected
    assert (pool.held(greedy), pool.held(other)) == (5, 5)
    world.ends(world.connect(encode_header(ASK), host=other))
    assert (pool.held(greedy), pool.held(other)) == (5, 5)
    publisher.send(encode_frame(b"on"))
    world.close()


def test_a_latched_message_that_waits_for_a_limit_counts_once(world: World) -> None:
    """It is offered each second, to a subscriber beside those that got it."""

    def limited() -> int:
        found = (row for one in world.told if isinstance(one, MessagesLimited) for row in one.rows)
        return sum(row.messages for row in found)

    world.state(GrantInstalled("k", "/chatter", LOOPBACK, "/slow", FlowLimit(messages=0.001)))
    publisher, quick = world.subscribed(HEADER | {"latching": "1"})
    slow = world.connect(encode_header(ASK | {"callerid": "/slow"}))
    world.gets_header(slow)
    for text in (b"1", b"2", b"3", b"4"):
        world.push(publisher, encode_frame(text))
        world.gets(quick, encode_frame(text))
    several_reports = clock.now() + 6 * LIMITS.report_every
    world.until(lambda: clock.now() > several_reports)
    slow.read()
    passed = len(slow.data) // len(encode_frame(b"1"))
    assert 0 < passed < 4
    assert limited() == 4 - passed
    slow.data.clear()
    world.state(GrantInstalled("k", "/chatter", LOOPBACK, "/slow", FlowLimit(messages=1000)))
    world.gets(slow, encode_frame(b"4"))
    assert limited() == 4 - passed


def test_limits_are_kept_for_publishers_and_for_each_subscriber_and_change_while_they_run(
    world: World,
) -> None:
    world.state(GrantInstalled("k", "/chatter", LOOPBACK, "/slow", FlowLimit(messages=2)))
    publisher, quick = world.subscribed()
    slow = world.connect(encode_header(ASK | {"callerid": "/slow"}))
    assert world.gets_header(slow) == HEADER
    frames = [encode_frame(b"%d" % number) for number in range(5)]
    publisher.send(b"".join(frames))
    world.gets(quick, b"".join(frames))
    world.gets(slow, frames[0])
    [row] = world.hears(MessagesLimited).rows
    assert row == LimitedRow("k", "/chatter", "subscriber", LOOPBACK, "/slow", 4, 20)
    world.state(GrantInstalled("k", "/chatter", LOOPBACK, "/slow"))
    world.state(PublicationPlaced("k", "/chatter", "*", FlowLimit(messages=4), FlowLimit(bytes=1e9)))
    publisher.send(b"".join(frames))
    for one in (quick, slow):
        world.gets(one, b"".join(frames[:2]))
    [row] = world.hears(MessagesLimited).rows
    assert row == LimitedRow("k", "/chatter", "publisher", LOOPBACK, "/talker", 3, 15)
    world.state(PublicationPlaced("k", "/chatter", "*", UNLIMITED, FlowLimit(bytes=20)))
    publisher.send(b"".join(frames))
    world.gets(quick, b"".join(frames[:2]))
    [row] = world.hears(MessagesLimited).rows
    assert (row.part, row.messages) == ("topic", 3)
    world.state(PublicationPlaced("k", "/chatter", "*"))
    publisher.send(b"".join(frames * 20))
    world.gets(quick, b"".join(frames * 20))


def test_a_limit_counts_hosts_and_not_node_names(world: World) -> None:
    publishers = []
    for key, host, topic in (
        ("g", "10.9.9.9", "/own"),
        ("h", "10.9.9.9", "/own"),
        ("g", "10.9.9.9", "/all"),
        ("h", "10.9.9.9", "/all"),
        ("r", "10.0.0.1", "/all"),
    ):
        if (key, host) not in publishers:
            publishers.append((key, host))
            world.state(NodePlaced(key, f"/{key}", host), world.listen())
        own, together = FlowLimit(messages=10), FlowLimit(messages=16)
        limits = (own, UNLIMITED) if topic == "/own" else (UNLIMITED, together)
        world.state(PublicationPlaced(key, topic, "*", *limits, counted_as=host))
    batch = Batch(memoryview(encode_frame(b"x") * 20), 20, None)
    passed = []
    for key, topic in (("g", "/own"), ("h", "/own"), ("g", "/all"), ("h", "/all"), ("r", "/all")):
        flow = world.engine.topics[key, topic].flow
        passing = flow.passing(batch, world.loop.clock(), latching=False)
        passed.append(0 if passing is None else passing.messages)
    mine, guest, robot = sum(passed[:2]), sum(passed[2:4]), passed[4]
    assert mine <= 6
    assert guest <= 7, "of the sixteen a host may have its part and what is common at once"
    assert robot >= 2, "whatever the guest has sent first"


def test_a_flood_beyond_its_limit_delays_no_other_topic(world: World) -> None:
    publisher, subscriber = world.subscribed()
    listening = world.listen()
    world.state(NodePlaced("g", "/guest", "10.9.9.9"), listening)
    world.state(PublicationPlaced("g", "/flood", "*", FlowLimit(messages=10)))
    world.state(GrantInstalled("g", "/flood", LOOPBACK, "/listener"))
    hearer = world.connect(encode_header(ASK | {"topic": "/flood"}), port=listening)
    guest = world.upstream(HEADER | {"topic": "/flood"}, key="g")
    world.gets_header(hearer)
    began, flood, sent = world.loop.clock(), encode_frame(bytes(100)) * 10_000, 0
    for number in range(2000):
        with contextlib.suppress(BlockingIOError):
            sent += guest.sock.send(flood[sent % len(flood) :])
        if sent > 5_000_000:
            break
        message = encode_frame(b"%d" % number)
        publisher.send(message)
        turns = 0
        while len(subscriber.data) < len(message):
            world.loop.turn(0.1)
            subscriber.read()
            turns += 1
        assert (turns <= 2, bytes(subscriber.data)) == (True, message)
        subscriber.data.clear()
    else:
        pytest.fail(f"the relay took only {sent} bytes of the flood")
    hearer.read()
    seconds = world.loop.clock() - began
    assert len(hearer.data) // 104 <= 10 * seconds + 6


@pytest.mark.parametrize("world", [replace(LIMITS, connect_seconds=0.3)], indirect=True)
def test_a_service_that_is_busy_lets_its_client_wait_as_in_plain_ros(world: World) -> None:
    client = world.connect(encode_header(CALL))
    service = world.accept(world.service)
    later = world.loop.clock() + 1.5 * IMPATIENT.connect_seconds
    world.until(lambda: world.loop.clock() > later)
    assert world.gets_header(service)["callerid"] == "/client"
    service.send(encode_header({"callerid": "/talker", "type": "x/Y", "md5sum": "m"}))
    assert world.gets_header(client)["md5sum"] == "m"
    client.send(encode_frame(b"q"))
    world.gets(service, encode_frame(b"q"))


@pytest.mark.parametrize("seed", range(20))
def test_a_call_reaches_its_server_whatever_overtakes_what(seed: int) -> None:
    world, order = World(), random.Random(seed)  # noqa: S311 - an order, no secret
    peer = world.connect()
    stated: list[Message] = []

    def state(message: Message) -> None:
        stated.append(message)
        world.control.send(message)

    def restate() -> None:
        world.control.send(StateBegan(9))
        world.control.send(NodePlaced("k", "/talker", LOOPBACK), (world.port.fileno(),))
        for message in stated:
            world.control.send(message)

    header = encode_header(CALL | {"service": "/add"})
    of_client = [
        lambda: peer.send(header[:20]),
        lambda: peer.send(header[20:]),
        lambda: peer.send(encode_frame(b"q")),
    ]
    of_control = [
        lambda: state(ServicePlaced("k", "/add", LOOPBACK, world.service.getsockname()[1])),
        lambda: state(ClientGranted("k", "/add", LOOPBACK, "/client")),
    ]
    order.shuffle(of_control)
    place = order.randrange(3)
    of_control[place:place] = [restate]
    of_control.insert(order.randrange(place + 1, 4), lambda: world.control.send(StateEnded(9)))
    while of_client or of_control:
        queue = order.choice([one for one in (of_client, of_control) if one])
        queue.pop(0)()
        for _ in range(order.randrange(3)):
            world.loop.turn(0.005)
    service = world.accept(world.service)
    world.gets_header(service)
    service.send(encode_header({"callerid": "/talker", "type": "x/Y", "md5sum": "m"}))
    world.gets(service, encode_frame(b"q"))
    world.close()


TOO_LONG = struct.pack("<I", LIMITS.message_bytes + 1)


@pytest.mark.parametrize(
    ("who", "data"),
    [
        ("client", TOO_LONG),
        ("service", b"\x01" + TOO_LONG),
        ("service", b"\x05abcd"),
        ("service", encode_service_reply(b"1") * 2),
    ],
)
def test_a_call_ends_with_the_one_who_breaks_the_protocol(world: World, who: str, data: bytes) -> None:
    client, service = world.call({"md5sum": "m"}, persistent="1")
    if who == "service":
        client.send(encode_frame(b""))
        world.gets(service, encode_frame(b""))
    {"client": client, "service": service}[who].send(data)
    world.ends(service)
    world.ends(client)
    assert world.hears(ConnectionClosed).reason
    assert world.held == 0


def test_a_client_that_never_reads_gets_no_second_request_through(world: World) -> None:
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
    unread = world.held
    assert second_arrived == (unread == 0), "the second request waits while the first reply is unread"
    world.gets_header(client)
    world.gets(client, encode_service_reply(bytes(3 * MIB + MIB // 2)))
    world.gets(service, encode_frame(b"2"))


def test_a_topic_with_many_subscribers_is_delivered_a_quantum_at_a_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(EventLoop, "over", lambda _loop: True)
    world = World(replace(LIMITS, connections=400, connections_per_host=100))
    publisher, first = world.subscribed()
    others = [world.connect(encode_header(ASK)) for _ in range(39)]
    for subscriber in others:
        world.gets_header(subscriber)
    topic = world.engine.topics["k", "/chatter"]
    messages = [encode_frame(f"{number}".encode() * 9) for number in range(5)]
    held = world.held
    publisher.send(messages[0])
    world.until(lambda: topic.undelivered)
    for subscriber in others:
        subscriber.read()
    assert sum(bool(subscriber.data) for subscriber in (first, *others)) <= 17
    assert world.held == held + topic.undelivered
    publisher.send(b"".join(messages[1:]))
    left = [others.pop(), others.pop(0)]
    for subscriber in left:
        subscriber.reset()
    late = world.connect(encode_header(ASK))
    for subscriber in (first, *others):
        world.gets(subscriber, b"".join(messages))
    world.gets_header(late)
    late.read()
    late.data.clear()  # read after the message arrived
    assert (topic.undelivered, world.held) == (0, held)
    publisher.send(messages[0])
    for subscriber in (first, *others, late):
        world.gets(subscriber, messages[0])
    world.close()


def test_subscribers_of_a_topic_that_is_gone_are_cut_a_quantum_at_a_time(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    _publisher, first = world.subscribed()
    others = [world.connect(encode_header(ASK)) for _ in range(5)]
    for subscriber in others:
        world.gets_header(subscriber)
    topic = world.engine.topics["k", "/chatter"]
    monkeypatch.setattr(world.loop, "over", lambda: True)
    world.state(FactWithdrawn(("publication", "k", "/chatter")))
    assert len(topic.members) == 5
    for subscriber in (first, *others):
        world.ends(subscriber)
    assert not topic.members


def test_a_second_is_reported_although_tidying_up_takes_many_turns(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(50):
        world.state(PublicationPlaced("k", f"/topic{number}", "*"))
    world.subscribed()
    world.hears(TrafficReported)
    monkeypatch.setattr(world.loop, "over", lambda: True)
    world.connect(encode_header(ASK))
    world.hears(TrafficReported)


def test_a_grant_is_compared_with_the_waiting_peers_of_its_host(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    hosts = ["127.0.0.2", "127.0.0.3"]
    for host in hosts:
        world.connect(encode_header({**ASK, "callerid": "/stranger"}), host=host)
    world.until(lambda: len(world.engine.waiting.get("k", ())) == len(hosts))
    compared: list[str] = []

    def counted(table: GrantTable, key: str, host: str, fields: Mapping[str, str]) -> str:
        compared.append(host)
        return missing(table, key, host, fields)

    monkeypatch.setattr("appliance.relay.data_plane.missing", counted)
    for number in range(50):
        world.state(GrantInstalled("k", "/chatter", LOOPBACK, f"/other{number}"))
    assert not compared
    world.state(GrantInstalled("k", "/chatter", hosts[1], "/stranger"))
    assert set(compared) == {hosts[1]}
    assert list(world.engine.waiting["k"]) == [hosts[0]]


def test_a_greeting_of_very_many_messages_ends_early(world: World) -> None:
    """The relay takes them one by one, in one turn."""
    publisher, first = world.subscribed(HEADER | {"latching": "1"})
    publisher.send(encode_frame(b"a") + encode_frame(b"b"))
    world.gets(first, encode_frame(b"a") + encode_frame(b"b"))
    world.state(GrantInstalled("k", "/chatter", LOOPBACK, "/second"))
    second = world.connect(encode_header(ASK | {"callerid": "/second"}))
    extra = world.accept(world.publisher)
    assert world.gets_header(extra)["callerid"] == "/rosrv_newcomer"
    extra.send(encode_header(HEADER | {"latching": "1"}) + encode_frame(b"") * 5000 + b"torn")
    world.gets_header(second)
    assert world.ends(extra) == b""
    world.gets(second, encode_frame(b"b") + encode_frame(b"") * 200)
