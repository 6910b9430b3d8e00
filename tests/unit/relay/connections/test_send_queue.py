"""The queue of one slow subscriber, compared with a naive one."""

import struct
from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.relay.bounds import Limits
from appliance.relay.connections.frames import LITTLE
from appliance.relay.connections.send_queue import Outbox
from tests.support.examples import examples
from tests.support.relay_memory import share

LIMITS = replace(Limits(), queue_messages=5, queue_bytes=100)


def frame(size: int, fill: int = 0) -> bytes:
    """A frame with a body of so many bytes."""
    return struct.pack("<I", size) + bytes([fill % 256]) * size


class NaiveOutbox:
    """The same rules on a list of frames and the rest of the one being sent."""

    def __init__(self) -> None:
        self.started = b""
        self.frames: list[bytes] = []

    def append(self, frames: list[bytes], sent: int) -> None:
        """Queue frames of which some bytes are sent."""
        self.frames += frames
        self.advance(sent)

    def advance(self, sent: int) -> None:
        """Take bytes off the front."""
        taken = min(sent, len(self.started))
        self.started, sent = self.started[taken:], sent - taken
        while sent:
            first = self.frames.pop(0)
            taken = min(sent, len(first))
            self.started, sent = first[taken:], sent - taken

    def trim(self) -> int:
        """Drop the oldest beyond the bounds."""
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
    """Whatever is queued, sent in parts and trimmed: same bytes, same counts, and memory accounted for."""
    budget = share(1 << 30)
    outbox, naive, number = Outbox(LIMITS, budget), NaiveOutbox(), 0
    for step in script:
        if step is None:
            assert outbox.trim() == naive.trim()
        elif isinstance(step, float):
            total = sum(map(len, outbox.vectors()))
            sent = int(step * total)
            outbox.advance(sent)
            naive.advance(sent)
        else:
            frames = [frame(size, number + index) for index, size in enumerate(step)]
            number += len(frames)
            data = b"".join(frames)
            sent = number % (len(data) + 1) if not outbox else 0
            outbox.append(memoryview(data), len(frames), sent)
            naive.append(frames, sent)
        assert b"".join(outbox.vectors()) == naive.started + b"".join(naive.frames)
        assert outbox.messages == len(naive.frames)
        assert outbox.size == sum(map(len, naive.frames))
        assert bool(outbox) == bool(naive.started or naive.frames)
        assert budget.used == len(naive.started) + outbox.size
    outbox.clear()
    assert budget.used == 0


def test_the_memory_of_a_message_that_is_nearly_sent_is_given_back() -> None:
    """What is held is not much more than what is counted, however little of it the subscriber takes at a time."""
    outbox, whole = Outbox(LIMITS, share(1 << 30)), frame(1 << 20)
    outbox.append(memoryview(whole), 1, 1)
    while outbox:
        [view] = outbox.vectors()
        assert bytes(view) == whole[-outbox.begun :]
        assert memoryview(view.obj).nbytes < LITTLE * outbox.begun
        outbox.advance(max(1, outbox.begun // 3))


def test_a_message_that_has_been_started_is_never_dropped() -> None:
    """The oldest are dropped, but what the subscriber has begun to read is finished."""
    outbox = Outbox(LIMITS, share(1 << 30))
    outbox.append(memoryview(b"".join(frame(4, index) for index in range(20))), 20, 3)
    assert outbox.full
    assert outbox.trim() == 14
    assert b"".join(outbox.vectors()) == frame(4, 0)[3:] + b"".join(
        frame(4, index) for index in range(15, 20)
    )


def test_one_message_larger_than_the_queue_is_dropped_whole() -> None:
    """The byte bound holds for a single message too."""
    outbox = Outbox(LIMITS, share(1 << 30))
    outbox.append(memoryview(frame(500)), 1)
    assert outbox.trim() == 1
    assert not outbox


def test_nothing_is_queued_when_the_process_is_out_of_memory() -> None:
    """The bound of the whole process comes before a subscriber's own."""
    budget = share(10)
    outbox = Outbox(LIMITS, budget)
    outbox.append(memoryview(frame(4) + frame(4)), 2)
    assert outbox.trim() == 2
    assert budget.used == 0


def test_the_rest_of_a_connection_header_goes_first() -> None:
    """A header that the socket did not take whole precedes all messages and is not counted as one."""
    outbox = Outbox(LIMITS, share(1 << 30))
    outbox.begin(memoryview(b"header"))
    outbox.append(memoryview(frame(4)), 1)
    assert b"".join(outbox.vectors()) == b"header" + frame(4)
    assert outbox.messages == 1
