import mmap
import struct
from unittest.mock import Mock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.relay.transport import frames
from appliance.relay.transport.frames import LARGE, SCRATCH, Batch, FrameReceiver, Scratch
from appliance.relay.transport.memory import HostMemory
from appliance.relay.transport.pump import walk
from roswire.errors import LimitExceededError, PeerError
from tests.support.examples import examples
from tests.support.relay_memory import share

LIMIT = 16 << 20


def frame(size: int, fill: int = 7) -> bytes:
    return struct.pack("<I", size) + bytes([fill % 256]) * size


def receiver(limit: int = LIMIT, memory: int = 1 << 30) -> tuple[FrameReceiver, HostMemory]:
    budget = share(memory)
    return FrameReceiver(Scratch(), limit, budget), budget


def feed(frame_receiver: FrameReceiver, data: bytes, cuts: list[int]) -> list[tuple[bytes, int, int]]:
    batches, position, turn = [], 0, 0
    while position < len(data):
        buffer = frame_receiver.buffer()
        count = min(len(buffer), cuts[min(turn, len(cuts) - 1)], len(data) - position)
        buffer[:count] = data[position : position + count]
        position, turn = position + count, turn + 1
        batch = frame_receiver.received(count)
        if batch is not None:
            assert batch.last is not None
            batches.append((bytes(batch.view), batch.messages, batch.last))
    return batches


def last_of(frame_receiver: FrameReceiver, data: bytes) -> Batch:
    feed(frame_receiver, data[:-1], [SCRATCH])
    frame_receiver.buffer()[0] = data[-1]
    batch = frame_receiver.received(1)
    assert batch is not None
    return batch


sizes = st.lists(
    st.one_of(st.integers(0, 300), st.integers(LARGE - 10, LARGE + 10), st.integers(0, 3 * LARGE)),
    max_size=12,
)
cut_sizes = st.lists(st.integers(1, 2 * LARGE), min_size=1, max_size=20)


@settings(max_examples=examples(150))
@given(sizes, cut_sizes)
def test_every_way_of_cutting_the_stream_gives_the_same_frames(lengths: list[int], cuts: list[int]) -> None:
    data = b"".join(frame(size, index) for index, size in enumerate(lengths))
    one, budget = receiver()
    batches = feed(
        one, data, [*cuts, max(cuts[-1], len(data) // 2000)]
    )  # millions of single bytes would test no more
    assert b"".join(view for view, _messages, _last in batches) == data
    assert sum(messages for _view, messages, _last in batches) == len(lengths)
    for view, _messages, last in batches:
        assert struct.unpack_from("<I", view, last)[0] == len(view) - last - 4
    one.trim_buffer()
    one.trim_buffer()
    assert budget.used == 0


def test_a_torn_frame_is_never_part_of_a_batch() -> None:
    one, budget = receiver()
    (batch,) = feed(one, frame(10) + frame(20) + frame(30)[:-1], [SCRATCH])
    assert batch == (frame(10) + frame(20), 2, 14)
    assert budget.used == len(frame(30)[:-1])


def test_receivers_share_the_scratch_area_without_mixing_their_bytes() -> None:
    scratch, budget = Scratch(), share(1 << 30)
    one, other = FrameReceiver(scratch, LIMIT, budget), FrameReceiver(scratch, LIMIT, budget)
    data = frame(100, 1)
    assert feed(one, data[:50], [50]) == []
    assert feed(other, frame(400, 2), [404])[0][0] == frame(400, 2)
    assert feed(one, data[50:], [54])[0][0] == data


def test_the_scratch_area_moves_between_two_reads() -> None:
    scratch, first, other = Scratch(), bytearray(SCRATCH), bytearray(SCRATCH)
    frame_receiver = FrameReceiver(scratch, LIMIT, share(1 << 30))
    scratch.move(memoryview(first))
    assert feed(frame_receiver, frame(100, 1)[:50], [50]) == []
    scratch.move(memoryview(other))
    assert feed(frame_receiver, frame(100, 1)[50:], [54]) == [(frame(100, 1), 1, 0)]
    assert (bytes(first[:60]), bytes(other[:104])) == (frame(100, 1)[:50] + bytes(10), frame(100, 1))


@pytest.mark.parametrize("size", [LIMIT + 1, 0xFFFFFFFF])
def test_a_length_beyond_the_limit_is_refused_at_its_first_bytes(size: int) -> None:
    one, budget = receiver()
    with pytest.raises(LimitExceededError, match=str(size)):
        feed(one, struct.pack("<I", size), [4])
    assert budget.used == 0


def test_the_limit_holds_for_a_frame_after_a_large_one() -> None:
    one, _budget = receiver()
    with pytest.raises(LimitExceededError):
        feed(one, frame(2 * LARGE) + struct.pack("<I", LIMIT + 1), [SCRATCH])


def test_a_declared_length_costs_nothing_until_its_bytes_come() -> None:
    one, budget = receiver()
    feed(one, struct.pack("<I", LIMIT) + b"x" * 10, [14])
    assert budget.used == 14
    one.abandon()
    assert budget.used == 0


@pytest.mark.parametrize("size", [2 * LARGE, 3 << 20, 8 << 20])
@pytest.mark.parametrize("earlier", ["none", "reused", "kept"])
def test_memory_that_is_resident_at_once_is_charged_at_once(size: int, earlier: str) -> None:
    """An area of up to 8 MiB is: it is made for the declared length."""
    one, budget = receiver(limit=16 << 20, memory=64 << 20)
    if earlier != "none":
        batch = last_of(one, frame(size - 4))
        if earlier == "kept":
            batch.keep()
    feed(one, struct.pack("<I", size - 4) + b"x", [5])
    assert budget.used == size
    other = FrameReceiver(Scratch(), 16 << 20, share(size // 2))
    with pytest.raises(PeerError, match="no memory"):
        feed(other, struct.pack("<I", size - 4), [4])


@pytest.mark.parametrize("size", [2 * LARGE, 9 << 20])
@pytest.mark.parametrize("kept", [False, True])
def test_a_publisher_that_gets_no_memory_is_given_up(
    size: int, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, _budget = receiver(limit=16 << 20)
    if kept:
        last_of(one, frame(2 * LARGE)).keep()
    monkeypatch.setattr(mmap, "mmap", Mock(side_effect=OSError(12, "no memory")))
    monkeypatch.setattr(frames, "bytearray", Mock(side_effect=MemoryError), raising=False)
    with pytest.raises(PeerError, match="no memory"):
        feed(one, frame(size), [LARGE])


def test_a_large_message_is_given_up_when_the_process_is_out_of_memory() -> None:
    one, budget = receiver(memory=2 * LARGE)
    with pytest.raises(PeerError, match="no memory"):
        feed(one, frame(4 * LARGE), [LARGE])
    one.abandon()
    assert budget.used == 0


@pytest.mark.parametrize("size", [2 * LARGE, 3 << 20, 9 << 20])
def test_a_kept_large_frame_is_not_overwritten_by_the_next(size: int) -> None:
    one, budget = receiver(limit=16 << 20)
    kept = []
    for fill in (1, 2, 3):
        data, position = frame(size, fill), 0
        while position < len(data):
            buffer = one.buffer()
            assert position or budget.used == 0, "the keeper counts a kept frame"
            count = min(len(buffer), len(data) - position)
            buffer[:count] = data[position : position + count]
            position += count
            batch = one.received(count)
            if batch is not None:
                kept.append(batch.keep_last().view if fill == 2 else batch.keep())
    assert [view[4] for view in kept] == [1, 2, 3]
    assert all(len(set(bytes(view[4:]))) == 1 for view in kept)


def test_a_kept_batch_survives_the_reuse_of_its_buffer() -> None:
    area = bytearray(frame(4, 1) + frame(4, 2))
    batch = Batch(memoryview(area), 2, 8)
    kept, last = batch.keep(), batch.keep_last()
    area[:] = bytes(len(area))
    assert bytes(kept) == frame(4, 1) + frame(4, 2)
    assert batch.keep() is kept
    assert (bytes(last.view), last.messages, last.last) == (frame(4, 2), 1, 0)


def test_for_little_of_a_large_frame_its_memory_is_not_kept() -> None:
    view = memoryview(bytearray(frame(1 << 20)))
    batch = Batch(view, 1, 0, owned=True)
    little, kept = batch.rest(len(view) - 1000), batch.kept
    view[-1] = 99
    assert bytes(little) == frame(1 << 20)[-1000:]
    assert batch.rest(1000).obj is view.obj
    assert (kept, batch.kept) == (False, True)
    assert batch.rest(len(view) - 1000).obj is view.obj


def test_a_walk_to_a_byte_ends_behind_the_frame_with_that_byte() -> None:
    view = memoryview(frame(6) + frame(0) + frame(10))
    assert [walk(view, size=offset) for offset in (-1, 0, 3, 10, 11, 14, 15, 28, 29)] == [
        (0, 0, 0),
        (0, 0, 0),
        (10, 1, 0),
        (10, 1, 0),
        (14, 2, 10),
        (14, 2, 10),
        (28, 3, 14),
        (28, 3, 14),
        (28, 3, 14),
    ]
    assert walk(memoryview(b"")) == walk(view, -1) == (0, 0, 0)


@given(st.lists(st.sampled_from([0, 5, 5, 252, 65_536]), max_size=12), st.integers(0, 9), st.integers(-1, 14))
def test_a_walk_passes_exactly_the_whole_frames(lengths: list[int], torn: int, most: int) -> None:
    data = b"".join(frame(length) for length in lengths) + frame(20)[:torn]
    passed = lengths[: max(most, 0)]
    size = sum(passed) + 4 * len(passed)
    assert walk(memoryview(data), most) == (size, len(passed), size - passed[-1] - 4 if passed else 0)


def test_a_read_of_many_frames_is_one_batch() -> None:
    one, budget = receiver()
    data = (frame(0) + frame(1)) * 50_000
    assert feed(one, data + frame(6)[:3], [SCRATCH]) == [(data, 100_000, len(data) - 5)]
    assert budget.used == 3


def test_the_last_frame_is_looked_for_where_it_is_not_known() -> None:
    view = memoryview(frame(6) + frame(0) + frame(10, 3))
    assert bytes(Batch(view, 3, None).keep_last().view) == frame(10, 3)
