import mmap
import os
from collections.abc import Callable, Iterator

import pytest

from appliance.base.clock import using, wall_ns
from appliance.features.recorder.excluded_topics import known_sums
from appliance.features.recorder.recorder_link import RingTerms
from appliance.features.recorder.recorder_ring import RecorderRing
from appliance.features.recorder.recording import RingReader
from appliance.features.recorder.ring import SMALLEST
from tests.support.virtual_clock import VirtualClock
from tests.unit.relay.connections.test_relayed_topic import HEADER, Story, batch

EVER = 0, 1 << 63


def given(descriptor: int, *, never: tuple[str, ...] = (), now: Callable[[], int] = wall_ns) -> RecorderRing:
    return RecorderRing(RingTerms(0, 1, 60, ["/chat*"], list(never)), os.dup(descriptor), now)


@pytest.fixture
def memory() -> Iterator[int]:
    descriptor = os.memfd_create("ring")
    os.ftruncate(descriptor, SMALLEST)
    yield descriptor
    os.close(descriptor)


def kept(descriptor: int) -> list[tuple[str, bytes]]:
    reader = RingReader(memoryview(mmap.mmap(descriptor, 0, prot=mmap.PROT_READ)))
    return [
        (found.header["topic"], bytes(message))
        for found in reader.read(*EVER)
        for batch in found.batches
        for message in batch.frames
    ]


def test_messages_dropped_by_monitors_are_recorded(memory: int) -> None:
    story = Story(sink=given(memory))
    story.topic.monitor(lambda _batch: None, wanted=True)
    member = story.join()
    story.topic.upstream_opened(HEADER)
    story.receive(batch(b"1", b"2"))
    story.topic.upstream_closed()
    assert member.received == b""
    assert kept(memory) == [("/chatter", b"1"), ("/chatter", b"2")]
    reader = RingReader(memoryview(mmap.mmap(memory, 0, prot=mmap.PROT_READ)))
    [found] = reader.read(*EVER)
    assert (found.header["callerid"], found.header["host"]) == ("/talker", "10.0.0.1")


@pytest.mark.parametrize("never", [("/chatter",), ("/ch?tter",), ("std_msgs/*",), ("std_msgs/String",)])
def test_excluded_topics_are_not_recorded(memory: int, never: tuple[str, ...]) -> None:
    header = {"type": "std_msgs/String", "md5sum": "*", "callerid": "/talker"}
    stream = given(memory, never=never).open("/chatter", "10.0.0.1", header)
    assert stream is not None
    stream.write(batch(b"secret").view, 1, 1)
    assert kept(memory) == []
    assert not stream.keeps
    assert given(memory).open("/other", "10.0.0.1", header) is None
    whole = given(memory).open("/chatter", "10.0.0.1", header)
    assert whole is not None
    assert whole.keeps


def test_a_topic_with_the_sum_of_another_type_is_recorded(memory: int) -> None:
    sums = known_sums(["sensor_msgs/Image"])
    recorded = RecorderRing(RingTerms(0, 1, 60, ["/*"], ["sensor_msgs/Image"], sums), os.dup(memory), wall_ns)
    header = {"type": "sensor_msgs/Image", "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1", "callerid": "/g"}
    stream = recorded.open("/orders", "10.0.0.9", header)
    assert stream is not None
    stream.write(batch(b"go").view, 1, 1)
    assert kept(memory) == [("/orders", b"go")]


def test_a_judged_message_has_the_time_of_its_judgement(memory: int) -> None:
    second, machine = 10**9, VirtualClock(wall=5000)
    with using(machine):
        stream = given(memory, now=lambda: 5000 * second + 7).open("/chatter", "10.0.0.1", HEADER)
        assert stream is not None
        stream.write(batch(b"1").view, 1, 1, 4999 * second)
        stream.write(batch(b"2").view, 1, 2)
        machine.advance(60)
        stream.write(batch(b"3").view, 1, 3, 5000 * second)
    reader = RingReader(memoryview(mmap.mmap(memory, 0, prot=mmap.PROT_READ)))
    [found] = reader.read(*EVER)
    assert [frames.time for frames in found.batches] == [4999 * second, 5000 * second + 7, 5060 * second - 7]


@pytest.mark.parametrize("size", [10, 100_000])
def test_each_message_is_recorded_once(memory: int, size: int) -> None:
    story = Story(sink=given(memory))
    member = story.join()
    story.topic.upstream_opened(HEADER)
    story.receive(batch(bytes(size), b"2"))
    story.topic.published(batch(b"3"))
    assert len(member.received) == size + 4 + 2 * 5
    assert kept(memory) == [("/chatter", bytes(size)), ("/chatter", b"2"), ("/chatter", b"3")]


def test_a_connection_that_ends_within_a_message_is_no_longer_recorded(memory: int) -> None:
    story = Story(sink=given(memory))
    story.join()
    story.topic.upstream_opened(HEADER)
    story.topic.tap(lambda _batch: story.topic.upstream_closed(), latched=False)
    story.receive(batch(bytes(100_000)))
    assert kept(memory) == []
