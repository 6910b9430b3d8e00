"""Write messages for the flight recorder into memory that the supervisor holds."""

import mmap
import os
from collections.abc import Callable, Mapping

import msgspec

from appliance.base import clock
from appliance.features.recorder.excluded_topics import fits, left_out_because
from appliance.features.recorder.quotas import RECORDER_MEMORY
from appliance.features.recorder.recorder_link import CLOCK_STEP, RingTerms
from appliance.features.recorder.ring import LEFT_OUT, RingStream, RingWriter

_TOPIC_SHARE = 0.25
_NOTHING = memoryview(b"")


class RecorderRing:
    """Writes one relay's messages, after the data that the previous process left.

    A message gets the time at which monitors judged it, so that a replay judges it at the same time.
    """

    def __init__(self, given: RingTerms, descriptor: int, now: Callable[[], int]) -> None:
        bounds = RECORDER_MEMORY.bounds
        # Map its pages at once: otherwise the first message on each page causes a page fault.
        memory = mmap.mmap(descriptor, 0, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE)
        self._topics, self._never, self._sums = given.topics, given.never, given.sums
        self._now, self._set = now, 0
        self._ring = RingWriter(
            memoryview(memory),
            topic_share=_TOPIC_SHARE,
            host_share=bounds.host / bounds.whole,
            seconds=given.seconds,
            clock=self._clock,
        )
        os.close(descriptor)

    def _clock(self, judged: int) -> int:
        now = self._now()
        ahead = clock.wall_ns() - now - self._set
        if abs(ahead) > CLOCK_STEP:
            self._set += ahead
        return (judged or now) + self._set

    def open(self, topic: str, host: str, header: Mapping[str, str]) -> "RingStream | ExcludedStream | None":
        if not fits(self._topics, topic):
            return None
        why = left_out_because(self._never, self._sums, topic, header)
        if not why:
            return self._ring.open(topic, host, {"message_definition": "", **header})
        marked = self._ring.open(topic, host, {**header, "message_definition": "", LEFT_OUT: why})
        return None if marked is None else ExcludedStream(marked)


class ExcludedStream:
    """A stream of which only the times of messages are recorded."""

    keeps = False

    def __init__(self, marked: RingStream) -> None:
        self._marked = marked

    def write(
        self, _frames: memoryview, _messages: int, first: int, judged: int = 0, *, carried: bool = True
    ) -> None:
        self._marked.write(_NOTHING, 0, first, judged, carried=carried)

    def close(self) -> None:
        self._marked.close()


def open_ring(terms: Mapping[str, object], descriptor: int, now: Callable[[], int]) -> RecorderRing:
    return RecorderRing(msgspec.convert(terms, RingTerms), descriptor, now)
