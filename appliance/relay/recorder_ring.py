"""What a relay leaves with the flight recorder: what publishers say, in memory that the supervisor holds."""

import mmap
import os
import time
from collections.abc import Callable, Mapping
from fnmatch import fnmatchcase

from appliance.channel.messages import RingGiven
from appliance.recorder.ring import RingWriter, Stream
from appliance.shares.table import RECORDER_MEMORY

_TOPIC_SHARE = 0.25
_STEP = 100_000_000  # nanoseconds


class Recorded:
    """Writes into the memory that was given, after what the process before it wrote; takes over the descriptor.

    What is recorded has the time at which it was judged by the monitors, whose clock is `now`: played back, they judge
    it at the same time again. When the machine's clock was set, the recording goes by that from then on.
    """

    def __init__(self, given: RingGiven, descriptor: int, now: Callable[[], int]) -> None:
        bounds = RECORDER_MEMORY.bounds
        # Its pages are mapped at once: else each is, by a fault, when the first message comes to it.
        memory = mmap.mmap(descriptor, 0, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE)
        self._topics, self._never = given.topics, given.never
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

    def open(self, topic: str, host: str, header: Mapping[str, str]) -> Stream | None:
        """Begin what a publisher says; None when that is not to be recorded, or has no room."""
        if not _fits(self._topics, topic) or _fits(self._never, topic, header.get("type", "")):
            return None
        return self._ring.open(topic, host, {"message_definition": "", **header})


def _fits(globs: list[str], *names: str) -> bool:
    return any(fnmatchcase(name, glob) for glob in globs for name in names)
