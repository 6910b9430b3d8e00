import contextlib
from collections.abc import Iterator
from dataclasses import replace
from unittest.mock import Mock

import pytest

from appliance.channel.messages import (
    ConnectionClosed,
    FactWithdrawn,
    GrantInstalled,
    LatchRefused,
    NodePlaced,
    PublicationPlaced,
    UpstreamLost,
)
from appliance.relay.relay_limits import MIB
from appliance.relay.transport.frames import FrameReceiver
from roswire.errors import LimitExceededError
from roswire.tcpros import encode_frame, encode_header, encode_service_reply
from tests.unit.relay.world import ASK, CALL, HEADER, LIMITS, LOOPBACK, Peer, World

pytestmark = pytest.mark.usefixtures("sockets")

SMALL_RELAY = replace(
    LIMITS,
    memory_bytes=64 * MIB,
    header_memory_bytes=MIB,
    message_bytes=16 * MIB,
    queue_bytes=16 * MIB,
    stall_seconds=0.4,
    connections=2000,
    connections_per_host=1000,
    header_seconds=60.0,
    connect_seconds=30.0,
)
IMAGE = encode_frame(bytes(2 * MIB))
LATCHED = HEADER | {"latching": "1"}


@pytest.fixture
def world() -> Iterator[World]:
    world = World(SMALL_RELAY)
    yield world
    world.close()


def publish(world: World, number: int, host: str, header: dict[str, str] = HEADER) -> tuple[Peer, Peer]:
    key, listening = f"guest{number}", world.listen()
    world.state(NodePlaced(key, f"/guest{number}", host), listening)
    world.state(PublicationPlaced(key, "/chatter", "*"))
    world.state(GrantInstalled(key, "/chatter", LOOPBACK, "/listener"))
    subscriber = world.connect(encode_header(ASK), port=listening)
    publisher = world.upstream(header, key=key)
    world.gets_header(subscriber)
    return publisher, subscriber


def carries_images(world: World, publisher: Peer, subscriber: Peer) -> None:
    for _ in range(10):
        world.push(publisher, IMAGE)
        world.gets(subscriber, IMAGE)


def test_latched_messages_of_a_guest_stop_no_other_host(world: World) -> None:
    robot = world.subscribed()
    message = encode_frame(bytes(MIB))
    refused = 0
    for number in range(30):
        publisher, subscriber = publish(world, number, "10.9.9.9", LATCHED)
        world.push(publisher, message)
        world.gets(subscriber, message)
        carries_images(world, *robot) if not number % 10 else None
        refused += any(isinstance(one, LatchRefused) and one.key == f"guest{number}" for one in world.told)
    assert world.engine.memory.latched.of("10.9.9.9").used < 9 * MIB
    assert world.hears(LatchRefused, key="guest29").size == len(message)
    assert refused > 20
    own, subscriber = publish(world, 100, LOOPBACK, LATCHED)
    world.push(own, message)
    world.gets(subscriber, message)
    assert world.engine.memory.latched.of(LOOPBACK).used == len(message)
    for number in range(29):
        world.state(FactWithdrawn(("node", f"guest{number}")))
    assert world.engine.memory.latched.of("10.9.9.9").used == 0
    carries_images(world, *robot)


def test_latched_messages_of_two_hundred_hosts_leave_room_for_the_robots(world: World) -> None:
    for number in range(200):
        size = 6 * MIB if number < 6 else 60_000
        message = encode_frame(bytes(size))
        publisher, subscriber = publish(world, number, f"10.9.0.{number}", LATCHED)
        world.push(publisher, message)
        world.gets(subscriber, message)
    robot, subscriber = publish(world, 200, LOOPBACK, LATCHED)
    message = encode_frame(bytes(2 * MIB))
    world.push(robot, message)
    world.gets(subscriber, message)
    assert world.engine.memory.latched.of(LOOPBACK).used == len(message)


def test_unfinished_messages_of_a_guest_stop_no_other_host(world: World) -> None:
    robot = world.subscribed()
    begun = encode_frame(bytes(8 * MIB))[: 2 * MIB]
    for number in range(40):
        publisher, _subscriber = publish(world, number, "10.9.9.9")
        with contextlib.suppress(ConnectionError):  # it may be cut before it has sent all
            world.pour(publisher, begun)
        if not number % 10:
            carries_images(world, *robot)
    assert world.engine.memory.frames.of("10.9.9.9").used < 18 * MIB
    world.hears(UpstreamLost, violation="limit exceeded")
    carries_images(world, *robot)
    world.until(lambda: world.engine.memory.frames.of("10.9.9.9").used == 0)


def test_subscribers_of_a_guest_that_never_read_stop_no_other_host(world: World) -> None:
    publisher, quick = world.subscribed()
    world.state(GrantInstalled("k", "/chatter", "127.0.0.2", "/stuck"))
    stuck = []
    for _ in range(40):
        peer = world.connect(encode_header(ASK | {"callerid": "/stuck"}), host="127.0.0.2")
        world.gets_header(peer)
        stuck.append(peer)
    large = encode_frame(bytes(5 * MIB))
    for _ in range(20):
        world.push(publisher, large)
        world.gets(quick, large)
    assert world.engine.memory.queues.of(LOOPBACK).used == 0
    share = world.engine.memory.queues.of("127.0.0.2")
    assert 0 < share.used < 16 * MIB
    share.add(8 * MIB)
    assert "no memory left" in world.hears(ConnectionClosed).reason
    share.add(-8 * MIB)
    world.until(lambda: not share.exhausted)
    for peer in stuck:
        peer.reset()
    world.until(lambda: share.used == 0)
    carries_images(world, publisher, quick)


@pytest.mark.parametrize("part", ["request", "reply"])
def test_a_service_call_may_be_as_large_as_a_message(world: World, part: str) -> None:
    """It waits in a queue whose quota is half of that. A host that has used its quota gets no further one."""
    large, small = bytes(14 * MIB), b"small"
    request, reply = (large, small) if part == "request" else (small, large)
    share = world.engine.memory.queues.of(LOOPBACK)
    client, service = world.call(persistent="1")
    world.push(client, encode_frame(request))
    world.gets(service, encode_frame(request))
    world.push(service, encode_service_reply(reply))
    world.gets(client, encode_service_reply(reply))
    assert share.used == 0
    share.add(8 * MIB)
    with contextlib.suppress(ConnectionError):
        world.pour(client, encode_frame(request))
        if part == "reply":
            world.gets(service, encode_frame(request))
            world.pour(service, encode_service_reply(reply))
    assert "no memory left" in world.hears(ConnectionClosed).reason
    assert share.used == 8 * MIB


def test_headers_of_unknown_hosts_leave_room_for_the_robots(world: World) -> None:
    unfinished = encode_header({"callerid": "/" + "x" * 30_000})[:-1]
    for number in range(100):
        world.connect(unfinished, host=f"127.0.1.{number + 1}")
        world.loop.turn(0.01)
    ours = world.connect(encode_header(ASK | {"filler": "x" * 30_000}))
    world.upstream()
    assert world.gets_header(ours)["callerid"] == "/talker"
    pool = world.engine.memory.headers
    assert 0 < pool.total <= MIB // 4 + len(unfinished)


def test_headers_of_publishers_and_servers_count_while_they_are_connected(world: World) -> None:
    share = world.engine.memory.frames.of("10.9.9.9")
    publisher, _subscriber = publish(world, 1, "10.9.9.9", HEADER | {"message_definition": "x" * 60_000})
    assert 60_000 < share.used < 61_000
    publisher.reset()
    world.until(lambda: share.used == 0)
    own = world.engine.memory.frames.of(LOOPBACK)
    client = world.connect(encode_header(CALL) + encode_frame(bytes(50_000)))
    service = world.accept(world.service)
    world.until(lambda: own.used > 50_000)
    world.gets_header(service)
    service.send(encode_header({"callerid": "/talker", "type": "x/Y", "md5sum": "m", "more": "x" * 40_000}))
    world.gets_header(client)
    world.until(lambda: 40_000 < own.used < 41_000)
    client.reset()
    world.until(lambda: own.used == 0)


@pytest.mark.parametrize("asked", [ASK, CALL])
def test_little_of_a_peers_header_is_kept(world: World, asked: dict[str, str]) -> None:
    long = world.connect(encode_header(asked | {"type": "x" * 2000}))
    assert world.gets_header(long)["error"] == "its header has a type of 2000 characters"
    world.connect(encode_header(asked | {"message_definition": "x" * 30_000, "own": "x" * 30_000}))
    members = lambda: [*world.engine.clients, *world.engine.topics["k", "/chatter"].members]  # noqa: E731 - said once
    [member] = world.until(members)
    assert set(member.fields) == set(asked)


def test_a_relay_without_memory_for_the_next_image_loses_its_publisher_alone(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FrameReceiver, "buffer", Mock(side_effect=LimitExceededError("no memory")))
    publisher, _subscriber = world.subscribed(LATCHED)  # the pump leaves it to Python
    publisher.send(encode_frame(b"x"))
    assert world.hears(UpstreamLost).reason == "no memory"
