import struct
from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.relay.connections.relayed_topic import LatchedMessage
from appliance.relay.connections.startup_replay import StartupReplay
from appliance.relay.connections.subscriber import SendQueue
from appliance.relay.relay_limits import RelayLimits
from appliance.relay.transport.frames import LITTLE, Batch
from tests.support.examples import examples
from tests.support.relay_memory import share

LIMITS = replace(RelayLimits(), queue_messages=5, queue_bytes=100)


def frame(size: int, fill: int = 0) -> bytes:
    return struct.pack("<I", size) + bytes([fill % 256]) * size


class NaiveOutbox:
    def __init__(self) -> None:
        self.started = b""
        self.frames: list[bytes] = []

    def append(self, frames: list[bytes], sent: int) -> None:
        self.frames += frames
        self.advance(sent)

    def advance(self, sent: int) -> None:
        taken = min(sent, len(self.started))
        self.started, sent = self.started[taken:], sent - taken
        while sent:
            first = self.frames.pop(0)
            taken = min(sent, len(first))
            self.started, sent = first[taken:], sent - taken

    def trim(self) -> int:
        dropped = 0
        while len(self.frames) > LIMITS.queue_messages or sum(map(len, self.frames)) > LIMITS.queue_bytes:
            self.frames.pop(0)
            dropped += 1
        return dropped


batches = st.lists(st.integers(0, 40), min_size=1, max_size=8)
steps = st.lists(st.one_of(batches, st.floats(0, 1), st.none()), max_size=30)


@settings(max_examples=examples(300))
@given(steps)
def test_the_outbox_does_what_a_list_of_frames_does(script: list[list[int] | float | None]) -> None:
    budget = share(1 << 30)
    queue, naive, number = SendQueue(LIMITS, budget, float), NaiveOutbox(), 0
    for step in script:
        if step is None:
            assert queue.trim() == naive.trim()
        elif isinstance(step, float):
            total = sum(map(len, queue.vectors()))
            sent = int(step * total)
            queue.advance(sent)
            naive.advance(sent)
        else:
            frames = [frame(size, number + index) for index, size in enumerate(step)]
            number += len(frames)
            data = b"".join(frames)
            sent = number % (len(data) + 1) if not queue else 0
            queue.append(Batch(memoryview(data), len(frames), None), sent)
            naive.append(frames, sent)
        assert b"".join(queue.vectors()) == naive.started + b"".join(naive.frames)
        assert queue.messages == len(naive.frames)
        assert queue.size == sum(map(len, naive.frames))
        assert bool(queue) == bool(naive.started or naive.frames)
        assert budget.used == len(naive.started) + queue.size
    queue.clear()
    assert budget.used == 0


def test_the_memory_of_a_message_that_is_nearly_sent_is_given_back() -> None:
    queue, whole = SendQueue(LIMITS, share(1 << 30), float), frame(1 << 20)
    queue.append(Batch(memoryview(whole), 1, None), 1)
    while queue:
        [view] = queue.vectors()
        assert bytes(view) == whole[-queue.begun :]
        assert memoryview(view.obj).nbytes < LITTLE * queue.begun
        queue.advance(max(1, queue.begun // 3))


def test_a_message_that_has_been_started_is_never_dropped() -> None:
    queue = SendQueue(LIMITS, share(1 << 30), float)
    queue.append(Batch(memoryview(b"".join(frame(4, index) for index in range(20))), 20, None), 3)
    assert queue.full
    assert queue.trim() == 14
    assert b"".join(queue.vectors()) == frame(4, 0)[3:] + b"".join(frame(4, index) for index in range(15, 20))


def test_one_message_larger_than_the_queue_is_dropped_whole() -> None:
    queue = SendQueue(LIMITS, share(1 << 30), float)
    queue.append(Batch(memoryview(frame(500)), 1, None))
    assert queue.trim() == 1
    assert not queue


@pytest.mark.parametrize("size", [1000, 30_000, 100_000, 900_000, 6 << 20])
@pytest.mark.parametrize("rate", [500_000, 1_000_000, 4_000_000])
def test_a_camera_over_a_slow_link_stays_in_the_present(size: int, rate: int) -> None:
    """A frame waits a second, and for the last MiB, however long the link is too slow for 30 frames a second."""
    now, sent, room, longest = 0.0, 0, 0.0, 0.0
    queue = SendQueue(RelayLimits(), share(1 << 30), lambda: now)
    batch = Batch(memoryview(frame(size)), 1, None)
    for number in range(30 * 30):
        now = number / 30
        queue.append(batch)
        queue.trim()
        room = min(room, size) + rate / 30
        while queue.messages and room >= size:
            room -= size
            longest = max(longest, now - (number + 1 - queue.messages) / 30)
            queue.advance(len(batch.view))
            sent += 1
    assert sent >= min(30 * 30, 25 * rate // size)
    assert longest <= 1.1 + max(1 << 20, 2 * size) / rate


def test_a_burst_that_nothing_follows_is_kept() -> None:
    now = 0.0
    queue = SendQueue(RelayLimits(), share(1 << 30), lambda: now)
    for _number in range(20):
        queue.append(Batch(memoryview(frame(1 << 20)), 1, None))
        now += 0.05
    now = 60.0
    assert queue.trim() == 0


def test_nothing_is_queued_when_the_process_is_out_of_memory() -> None:
    budget = share(10)
    queue = SendQueue(LIMITS, budget, float)
    queue.append(Batch(memoryview(frame(4) + frame(4)), 2, None))
    assert queue.trim() == 2
    assert budget.used == 0


def test_the_rest_of_a_connection_header_goes_first() -> None:
    queue = SendQueue(LIMITS, share(1 << 30), float)
    queue.begin(memoryview(b"header"))
    queue.append(Batch(memoryview(frame(4)), 1, None))
    assert b"".join(queue.vectors()) == b"header" + frame(4)
    assert queue.messages == 1


def latched(batch: Batch) -> list[memoryview]:
    latch = LatchedMessage(share(), lambda _size: None, lambda _size: None)
    latch.keep(batch)
    assert latch.batch is not None
    return [latch.batch.view]


def replayed(batch: Batch) -> list[memoryview]:
    replay = StartupReplay(share(), 1.0)
    replay.opened(0.0, alone=True)
    replay.add(batch, 0.0)
    return [one.view for one in replay.give("/listener", 0.0)]


def queued(batch: Batch, *, sent: int = 0, advanced: int = 0) -> list[memoryview]:
    queue = SendQueue(replace(RelayLimits(), queue_messages=1000), share(), float)
    queue.append(batch, sent)
    queue.advance(advanced)
    queue.trim()
    return queue.vectors()


def kept(batch: Batch) -> Batch:
    batch.keep()
    return batch


KEEPERS: dict[str, Callable[[Batch], list[memoryview]]] = {
    "latch": latched,
    "replay": replayed,
    "rest of a turn": lambda batch: [batch.tail(1).view],
    "queue": queued,
    "queue behind": lambda batch: queued(batch, sent=max(0, len(batch.view) - 6)),
    "queue of a fast one": lambda batch: queued(batch, advanced=max(0, len(batch.view) - 6)),
    "second queue": lambda batch: queued(kept(batch), sent=max(0, len(batch.view) - 6)),
}


@pytest.mark.parametrize("keeper", KEEPERS)
@pytest.mark.parametrize("size", [512 << 10, 8 << 20])
@pytest.mark.parametrize("messages", [1, 2, 200, 131_072])
@pytest.mark.parametrize("owned", [False, True])
def test_little_of_a_read_does_not_keep_its_buffer(
    keeper: str, size: int, messages: int, owned: bool
) -> None:
    """Only the kept bytes are counted."""
    views = KEEPERS[keeper](Batch(memoryview(bytearray(size))[: 4 * messages], messages, None, owned=owned))
    assert views or messages > 200
    for view in views:
        assert memoryview(view.obj).nbytes < LITTLE * len(view)
