"""What a relay leaves with the flight recorder: what publishers say, in memory that the supervisor holds."""

import mmap
import os
from collections.abc import Mapping
from fnmatch import fnmatchcase

from appliance.channel.messages import RingGiven
from appliance.recorder.ring import RingWriter, Stream
from appliance.shares.table import RECORDER_MEMORY

_TOPIC_SHARE = 0.25


class Recorded:
    """Writes into the memory that was given, after what the process before it wrote; takes over the descriptor."""

    def __init__(self, given: RingGiven, descriptor: int) -> None:
        bounds = RECORDER_MEMORY.bounds
        # Its pages are mapped at once: else each is, by a fault, when the first message comes to it.
        memory = mmap.mmap(descriptor, 0, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE)
        self._topics, self._never = given.topics, given.never
        self._ring = RingWriter(
            memoryview(memory),
            topic_share=_TOPIC_SHARE,
            host_share=bounds.host / bounds.whole,
            seconds=given.seconds,
        )
        os.close(descriptor)

    def open(self, topic: str, host: str, header: Mapping[str, str]) -> Stream | None:
        """Begin what a publisher says; None when that is not to be recorded, or has no room."""
        if not _fits(self._topics, topic) or _fits(self._never, topic, header.get("type", "")):
            return None
        return self._ring.open(topic, host, {"message_definition": "", **header})


def _fits(globs: list[str], *names: str) -> bool:
    return any(fnmatchcase(name, glob) for glob in globs for name in names)
