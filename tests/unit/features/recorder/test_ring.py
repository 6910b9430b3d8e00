import mmap
import os
import random
import signal
import struct
import sys
import textwrap
from itertools import pairwise
from pathlib import Path

import pytest

from appliance.features.recorder import recording
from appliance.features.recorder.recording import RingReader, StreamFrames
from appliance.features.recorder.ring import (
    DATA,
    SMALLEST,
    RingStream,
    RingWriter,
    birth_at,
    geometry,
    rows,
    words_of,
)

EVER = 0, 1 << 63
HEADER = {
    "type": "std_msgs/String", "md5sum": "5" * 32, "message_definition": "string data\n", "callerid": "/talker",
}  # fmt: skip


def frame(body: bytes) -> bytes:
    return struct.pack("<I", len(body)) + body


class Clock:
    def __init__(self, now: int = 1) -> None:
        self.now = now

    def __call__(self, judged: int = 0) -> int:
        return judged or self.now


def ring(memory: memoryview, clock: Clock | None = None) -> RingWriter:
    return RingWriter(memory, topic_share=0.25, host_share=0.5, seconds=1e-6, clock=clock or Clock())


def opened(writer: RingWriter, topic: str = "/a", host: str = "10.0.0.1", **header: str) -> RingStream:
    stream = writer.open(topic, host, HEADER | header)
    assert stream is not None
    return stream


def texts(frames: list[StreamFrames], topic: str = "/a") -> list[bytes]:
    return [
        bytes(body)
        for one in frames
        if one.header["topic"] == topic
        for batch in one.batches
        for body in batch.frames
    ]


@pytest.fixture
def memory() -> memoryview:
    return memoryview(mmap.mmap(-1, SMALLEST))


def test_read_as_written(memory: memoryview) -> None:
    stream = opened(ring(memory, Clock(7)))
    reader = RingReader(memory)
    stream.write(memoryview(frame(b"one") + frame(b"two")), 2, 1)
    (found,) = reader.read(*EVER)
    assert found.header == {**HEADER, "topic": "/a", "host": "10.0.0.1"}
    assert [(batch.time, batch.first, list(map(bytes, batch.frames))) for batch in found.batches] == [
        (7, 1, [b"one", b"two"])
    ]
    assert list(reader.read(*EVER)) == []
    stream.write(memoryview(frame(b"three")), 1, 3)
    assert texts(list(reader.read(*EVER))) == [b"three"]


def test_records_across_blocks(memory: memoryview) -> None:
    block = geometry(SMALLEST).block
    bodies = [
        bytes([size % 251]) * size for size in (*range(block - 80, block + 9), 3 * block, 0, 5 * block + 1)
    ]
    stream = opened(ring(memory))
    reader, seen = RingReader(memory), []
    for number, body in enumerate(bodies, 1):
        stream.write(memoryview(frame(body)), 1, number)
        if number % 3 == 0:
            new = list(reader.read(*EVER))
            assert not any(found.torn for found in new)
            seen += texts(new)
    assert seen + texts(list(reader.read(*EVER))) == bodies


def test_only_the_requested_time_is_read(memory: memoryview) -> None:
    clock = Clock()
    stream = opened(ring(memory, clock))
    for number in range(1, 10):
        clock.now = number
        stream.write(memoryview(frame(str(number).encode())), 1, number)
    assert texts(list(RingReader(memory).read(4, 6))) == [b"4", b"5", b"6"]


def test_later_messages_are_for_the_next_call(memory: memoryview) -> None:
    clock = Clock(10)
    writer = ring(memory, clock)
    stream = opened(writer)
    reader = RingReader(memory)
    for number in range(1, 6):
        clock.now = number * 10
        stream.write(memoryview(frame(bytes([number]))), 1, number)
    assert texts(list(reader.read(20, 30))) == [b"\x02", b"\x03"]
    assert texts(list(reader.read(20, 30))) == []
    assert texts(list(reader.read(20, 90))) == [b"\x04", b"\x05"]


def test_table_that_changes_while_it_is_copied(memory: memoryview, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = ring(memory)
    stream = opened(writer)
    for number in range(1, 4):
        stream.write(memoryview(frame(bytes([number]) * 100)), 1, number)
    early = dict(rows(memory))
    full = 4
    while True:
        stream.write(memoryview(frame(bytes([full]) * 100)), 1, full)
        if sum(row.number == 1 and row.kind == DATA and row.sound for _at, row in rows(memory)):
            break
        full += 1
    mixed = [(at, early[at] if early[at].sound else row) for at, row in rows(memory)]
    monkeypatch.setattr(recording, "rows", lambda _memory: mixed)
    found = list(RingReader(memory).read(*EVER))
    assert texts(found) == [bytes([number]) * 100 for number in range(1, full + 1)]
    assert not found[0].torn


def test_a_flood_displaces_only_itself(memory: memoryview) -> None:
    writer = ring(memory)
    quiet, busy = opened(writer, "/quiet"), opened(writer, "/busy")
    flood = opened(writer, "/flood", "10.0.0.2")
    body = bytes(10_000)
    for number in range(1, 10_001):
        flood.write(memoryview(frame(body)), 1, number)
        if number % 500 == 0:
            quiet.write(memoryview(frame(b"q%d" % number)), 1, number // 500)
            busy.write(memoryview(frame(body)), 1, number // 500)
    found = list(RingReader(memory).read(*EVER))
    assert len(texts(found, "/quiet")) == 20
    assert len(texts(found, "/busy")) == 20
    (flooded,) = (one for one in found if one.header["topic"] == "/flood")
    assert flooded.torn
    assert flooded.batches[-1].first == 10_000
    firsts = [batch.first for batch in flooded.batches]
    assert firsts == list(range(firsts[0], 10_001))


def test_many_topics_of_a_host_displace_only_its_own(memory: memoryview) -> None:
    writer = ring(memory)
    quiet = opened(writer, "/quiet")
    quiet.write(memoryview(frame(b"here")), 1, 1)
    streams = [opened(writer, f"/flood{index}", "10.0.0.2") for index in range(12)]
    opened(writer, "/other", "10.0.0.3").write(memoryview(frame(bytes(200_000))), 1, 1)
    for number in range(1, 3001):
        streams[number % 12].write(memoryview(frame(bytes(3000))), 1, number)
    assert texts(list(RingReader(memory).read(*EVER)), "/quiet") == [b"here"]


def test_a_single_topic_may_fill_the_ring(memory: memoryview) -> None:
    stream = opened(ring(memory))
    for number in range(1, 81):
        stream.write(memoryview(frame(bytes(10_000))), 1, number)
    assert len(texts(list(RingReader(memory).read(*EVER)))) == 80


def test_large_messages_after_a_partly_displaced_one(memory: memoryview) -> None:
    stream = opened(ring(memory))
    for number in range(1, 41):
        stream.write(memoryview(frame(bytes([number]) * 150_000)), 1, number)
    (found,) = RingReader(memory).read(*EVER)
    assert found.torn
    assert [batch.first for batch in found.batches] == list(range(41 - len(found.batches), 41))
    assert len(found.batches) == 6  # of 38 blocks each, of 251
    assert all(
        bytes(body) == bytes([batch.first]) * 150_000 for batch in found.batches for body in batch.frames
    )


def test_a_record_beyond_the_quota_is_counted(memory: memoryview) -> None:
    stream = opened(ring(memory))
    stream.write(memoryview(frame(bytes(SMALLEST // 2))), 1, 1)
    stream.write(memoryview(frame(b"small")), 1, 2)
    reader = RingReader(memory)
    assert texts(list(reader.read(*EVER))) == [b"small"]
    assert reader.not_there == (1, 0)


def test_headers_of_a_host_are_bounded(memory: memoryview) -> None:
    writer = ring(memory)
    assert None in [writer.open(f"/t{index}", "10.0.0.2", HEADER) for index in range(1000)]
    assert RingReader(memory).not_there[1] > 0
    opened(writer)


def test_headers_end_with_their_streams(memory: memoryview) -> None:
    writer = ring(memory)
    for number in range(1000):
        stream = opened(writer, f"/t{number}")
        stream.write(memoryview(frame(bytes(9000))), 1, 1)
        stream.close()
    assert RingReader(memory).not_there == (0, 0)


def test_the_next_writer_continues(memory: memoryview) -> None:
    opened(ring(memory)).write(memoryview(frame(b"before")), 1, 1)
    clock = Clock(100)
    writer = ring(memory, clock)
    stream = opened(writer)
    stream.write(memoryview(frame(b"after")), 1, 1)
    assert texts(list(RingReader(memory).read(*EVER))) == [b"before", b"after"]
    clock.now += 1001
    for number in range(2, 400):
        stream.write(memoryview(frame(bytes(9000))), 1, number)
    assert b"before" not in texts(list(RingReader(memory).read(*EVER)))


def test_old_messages_are_dropped_first(memory: memoryview) -> None:
    clock = Clock()
    writer = ring(memory, clock)
    burst, seldom, flood = opened(writer, "/burst"), opened(writer, "/seldom"), opened(writer, "/flood")
    seldom.write(memoryview(frame(b"early")), 1, 1)
    burst.write(memoryview(frame(bytes(100_000))), 1, 1)
    for number in range(1, 1001):
        clock.now += 3
        flood.write(memoryview(frame(bytes(9000))), 1, number)
        if number % 100 == 0:
            seldom.write(memoryview(frame(b"later")), 1, 1 + number // 100)
    found = list(RingReader(memory).read(*EVER))
    assert texts(found, "/seldom") == [b"early", *[b"later"] * 10]
    assert texts(found, "/burst") == []


def test_a_stream_that_lost_its_block_begins_another(memory: memoryview) -> None:
    clock = Clock()
    writer = ring(memory, clock)
    silent, flood = opened(writer, "/silent"), opened(writer, "/flood")
    silent.write(memoryview(frame(b"lost")), 1, 1)
    clock.now += 2000
    for number in range(1, 1001):
        flood.write(memoryview(frame(bytes(9000))), 1, number)
    silent.write(memoryview(frame(b"back")), 1, 2)
    found = list(RingReader(memory).read(*EVER))
    assert texts(found, "/silent") == [b"back"]
    assert all(len(body) == 9000 for body in texts(found, "/flood"))


_WRITER = textwrap.dedent("""
    import mmap, struct, sys
    from appliance.features.recorder.ring import RingWriter
    memory = memoryview(mmap.mmap(int(sys.argv[1]), 0))
    writer = RingWriter(memory, topic_share=0.25, host_share=0.9, seconds=60)
    header = {"type": "t/T", "md5sum": "5" * 32, "message_definition": "x" * 6000, "callerid": "/n"}
    streams = [writer.open("/t%d" % index, "10.0.0.1", header) for index in range(4)]
    print("writes", end="", flush=True)
    number = 0
    while True:
        number += 1
        for index, stream in enumerate(streams):
            body = struct.pack("<QI", number, index) * (1 + number * (index + 7) % 900)
            stream.write(memoryview(struct.pack("<I", len(body)) + body), 1, number)
""")


@pytest.mark.nightly
def test_killed_at_random(tmp_path: Path) -> None:
    chance = random.Random(7)  # noqa: S311 - to find the same again
    descriptor = os.memfd_create("ring")
    os.ftruncate(descriptor, SMALLEST)
    memory = memoryview(mmap.mmap(descriptor, 0))
    script = tmp_path / "writer.py"
    script.write_text(_WRITER)
    streams_of_all: set[int] = set()
    for _ in range(30):
        read, write = os.pipe()
        pid = os.posix_spawn(
            sys.executable,
            [sys.executable, str(script), str(descriptor)],
            {**os.environ, "PYTHONPATH": str(Path.cwd())},
            file_actions=[(os.POSIX_SPAWN_DUP2, write, 1), (os.POSIX_SPAWN_DUP2, descriptor, descriptor)],
        )
        os.close(write)
        assert os.read(read, 6) == b"writes"
        os.close(read)
        words, wanted = words_of(memory), chance.randrange(1, 600)
        newest = max(words[birth_at(block)] for block, _row in rows(memory))
        while max(row.birth for _block, row in rows(memory)) < newest + wanted:
            # The kill comes at a random time after `wanted` blocks.
            assert os.waitpid(pid, os.WNOHANG) == (0, 0), "the writer has ended by itself"
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        found = list(RingReader(memory).read(*EVER))
        newest_streams = sorted(one.stream for one in found)[-4:]
        assert not streams_of_all.intersection(newest_streams)
        streams_of_all.update(newest_streams)
        for one in found:
            numbers = [batch.first for batch in one.batches]
            assert all(later == earlier + 1 for earlier, later in pairwise(numbers))
            for batch in one.batches:
                (body,) = batch.frames
                index = int(one.header["topic"][2:])
                size = 1 + batch.first * (index + 7) % 900
                assert body == struct.pack("<QI", batch.first, index) * size
    os.close(descriptor)


def test_hostile_bytes_do_no_harm(memory: memoryview) -> None:
    chance = random.Random(11)  # noqa: S311 - to find the same again
    for turn in range(60):
        stream = opened(ring(memory))
        for number in range(1, 60):
            stream.write(memoryview(frame(bytes(chance.randrange(9000)))), 1, number)
        for _ in range(400):
            at = chance.choice((chance.randrange(4096, 4096 + 64 * 250), chance.randrange(SMALLEST)))
            memory[at] = chance.randrange(256)
        found = list(RingReader(memory).read(*EVER))
        assert sum(len(body) for one in found for batch in one.batches for body in batch.frames) <= SMALLEST
        writer = ring(memory)
        fresh = opened(writer, f"/fresh{turn}", "10.0.0.9")
        fresh.write(memoryview(frame(b"still")), 1, 1)
        assert texts(list(RingReader(memory).read(*EVER)), f"/fresh{turn}") == [b"still"]
