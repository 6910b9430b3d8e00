"""Monitors decide large frames by their start; the relay passes on or discards the rest while it arrives."""

import struct
from collections.abc import Iterator

import pytest

from appliance.channel.messages import MonitorRow, MonitorsCounted
from appliance.relay.connections.headers import size_of
from roswire.tcpros import encode_frame, encode_header
from tests.unit.relay.connections.test_large_frames import gets_part
from tests.unit.relay.monitors.monitored import Monitored
from tests.unit.relay.world import ASK, HEADER, LIMITS, Peer

IMAGE = HEADER | {"type": "sensor_msgs/Image", "md5sum": "060021388200f6f0f447d0fcd9c64743"}
CAMERA = """
camera() {
    int seen = 0;
    event shown(unsigned int height) /chatter sensor_msgs/Image '{height:height}' {
        seen = seen + 1;
        if (height == 7) { return; }
        if (height == 1) height = 2;
    }
}
"""


def image(height: int, size: int = 600_000) -> bytes:
    """Return the frame of an image."""
    body = struct.pack("<IIII", 0, 0, 0, 0) + struct.pack("<II", height, 1) + struct.pack("<I", 0)
    return encode_frame(body + struct.pack("<BII", 0, 1, size) + bytes([height]) * size)


@pytest.fixture
def monitored() -> Iterator[Monitored]:
    """Run a relay that takes specifications."""
    world = Monitored(LIMITS)
    yield world
    world.close()


def watched(world: Monitored) -> tuple[Peer, Peer]:
    """Return a publisher of images and its subscriber, after the first messages, which the engine takes."""
    subscriber = world.connect(encode_header(ASK | {"type": "*", "md5sum": "*"}))
    publisher = world.upstream(IMAGE)
    assert world.gets_header(subscriber) == IMAGE
    world.push(publisher, image(5, 10) * 10)
    world.gets(subscriber, image(5, 10) * 10)
    return publisher, subscriber


def counted(world: Monitored, events: int) -> MonitorRow | None:
    """Return the monitor's counters once they contain this number of events."""
    rows = [row for message in world.told if isinstance(message, MonitorsCounted) for row in message.rows]
    return rows[-1] if rows and rows[-1].events >= events else None


def test_a_monitor_that_needs_only_the_start_decides_before_the_rest_arrives(monitored: Monitored) -> None:
    """The subscriber gets the first half while the second has not been sent."""
    monitored.load(CAMERA)
    publisher, subscriber = watched(monitored)
    frame = image(5)
    monitored.push(publisher, frame[:300_000])
    gets_part(monitored, subscriber, frame[:300_000])
    monitored.push(publisher, frame[300_000:])
    monitored.gets(subscriber, frame)


def test_a_start_is_awaited_before_monitors_decide(monitored: Monitored) -> None:
    """A frame of which little has arrived is neither passed on nor decided."""
    monitored.load(CAMERA)
    publisher, subscriber = watched(monitored)
    frame = image(5)
    for start, end in ((0, 3), (3, 5000)):
        monitored.push(publisher, frame[start:end])
        monitored.loop.turn(0.02)
        subscriber.read()
        assert not subscriber.data
    monitored.push(publisher, frame[5000:10_000])
    gets_part(monitored, subscriber, frame[:10_000])
    monitored.push(publisher, frame[10_000:])
    monitored.gets(subscriber, frame)


def test_large_messages_are_changed_and_dropped_whoever_decides(monitored: Monitored) -> None:
    """The first message of a kind in a second is reported and taken whole; the others are decided by their start."""
    monitored.load(CAMERA)
    publisher, subscriber = watched(monitored)
    heights = [1, 5, 7, *[5] * 8, 7, 1, 7, 5, *[5] * 8, 1]
    for height in heights:
        monitored.push(publisher, image(height))
    changed = image(1)[:20] + struct.pack("<I", 2) + image(1)[24:]
    monitored.gets(subscriber, b"".join(changed if one == 1 else image(one) for one in heights if one != 7))
    row = monitored.until(lambda: counted(monitored, 10 + len(heights)))
    assert (row.events, row.drops, row.changes) == (10 + len(heights), heights.count(7), heights.count(1))


def test_a_dropped_frame_is_discarded_while_it_arrives(monitored: Monitored) -> None:
    """No memory is held for it, and the next frame follows. The first drop in a second is reported, so taken whole."""
    monitored.load(CAMERA)
    publisher, subscriber = watched(monitored)
    least = 1 << 30
    for _ in range(10):
        monitored.push(publisher, image(7) + image(5, 10) * 10)
        monitored.gets(subscriber, image(5, 10) * 10)
        monitored.push(publisher, image(7)[:300_000])
        for _ in range(50):
            monitored.loop.turn(0)
        least = min(least, monitored.held)
        monitored.push(publisher, image(7)[300_000:] + image(5))
        monitored.gets(subscriber, image(5))
        if least == size_of(IMAGE):
            break
    assert least == size_of(IMAGE)


def test_a_monitor_that_is_loaded_during_a_frame_decides_the_next_one(monitored: Monitored) -> None:
    """The frame that has begun is completed."""
    publisher, subscriber = watched(monitored)
    monitored.push(publisher, image(7)[:300_000])
    gets_part(monitored, subscriber, image(7)[:300_000])
    monitored.load(CAMERA)
    monitored.push(publisher, image(7)[300_000:] + image(7) + image(5))
    monitored.gets(subscriber, image(7) + image(5))


def test_a_monitor_that_reads_on_gets_whole_frames(monitored: Monitored) -> None:
    """The message is decided by its end."""
    event = "shown(int last) /chatter sensor_msgs/Image '{data[599999]:last}' when (last == 7) { return; }"
    monitored.load(f"end() {{ event {event} }}")
    publisher, subscriber = watched(monitored)
    monitored.push(publisher, image(7) + image(5)[:300_000])
    monitored.until(lambda: monitored.held > 200_000)
    subscriber.read()
    assert not subscriber.data
    monitored.push(publisher, image(5)[300_000:] + image(7) + image(6))
    monitored.gets(subscriber, image(5) + image(6))
