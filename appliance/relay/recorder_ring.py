"""What a relay leaves with the flight recorder: what publishers say, in memory that the supervisor holds."""

import mmap
import os
import time
from collections.abc import Callable, Mapping

from appliance.channel.messages import RingGiven
from appliance.quotas.table import RECORDER_MEMORY
from appliance.recorder.never import fits, left_out_because
from appliance.recorder.ring import LEFT_OUT, RingWriter, Stream

_TOPIC_SHARE = 0.25
_STEP = 100_000_000  # nanoseconds
_NOTHING = memoryview(b"")


class Recorded:
    """Writes into the memory that was given, after what the process before it wrote; takes over the descriptor.

    What is recorded has the time at which it was judged by the monitors, whose clock is `now`: played back, they judge
    it at the same time again. When the machine's clock was set, the recording goes by that from then on.
    """

    def __init__(self, given: RingGiven, descriptor: int, now: Callable[[], int]) -> None:
        bounds = RECORDER_MEMORY.bounds
        # Its pages are mapped at once: else each is, by a fault, when the first message comes to it.
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
        ahead = time.time_ns() - now - self._set
        if abs(ahead) > _STEP:
            self._set += ahead
        return (judged or now) + self._set

    def open(self, topic: str, host: str, header: Mapping[str, str]) -> "Stream | LeftOut | None":
        """Begin to keep a publisher's messages; None when they are not to be recorded, or have no room."""
        if not fits(self._topics, topic):
            return None
        why = left_out_because(self._never, self._sums, topic, header)
        if not why:
            return self._ring.open(topic, host, {"message_definition": "", **header})
        marked = self._ring.open(topic, host, {**header, "message_definition": "", LEFT_OUT: why})
        return None if marked is None else LeftOut(marked)


class LeftOut:
    """The stream of a publisher whose messages are left out: it has when they came, and nothing of them."""

    keeps = False

    def __init__(self, marked: Stream) -> None:
        self._marked = marked

    def write(self, _frames: memoryview, _messages: int, first: int, judged: int = 0) -> None:
        """Leave a mark in place of these frames."""
        self._marked.write(_NOTHING, 0, first, judged)

    def close(self) -> None:
        """Nothing more comes."""
        self._marked.close()
