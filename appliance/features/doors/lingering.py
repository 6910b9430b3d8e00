"""End topics some seconds after their last client has left, unless a client comes back."""

import asyncio
from collections.abc import Callable


class Lingering:
    """Calls `end(topic)` `seconds` after `left(topic)`, unless `used(topic)` comes first. All share one timer."""

    def __init__(self, seconds: float, end: Callable[[str], object]) -> None:
        self._seconds = seconds
        self._end = end
        self._ends: dict[str, float] = {}  # the first to end first
        self._timer: asyncio.TimerHandle | None = None

    def left(self, topic: str) -> None:
        self.used(topic)
        self._ends[topic] = asyncio.get_running_loop().time() + self._seconds
        if self._timer is None:
            self._start()

    def used(self, topic: str) -> None:
        self._ends.pop(topic, None)

    def pop(self) -> str | None:
        """Return the topic that would end first, which the caller ends."""
        topic = next(iter(self._ends), None)
        if topic is not None:
            del self._ends[topic]
        return topic

    def close(self) -> None:
        self._ends.clear()
        if self._timer is not None:
            self._timer.cancel()

    def _start(self) -> None:
        first = next(iter(self._ends.values()))
        self._timer = asyncio.get_running_loop().call_at(first, self._ring)

    def _ring(self) -> None:
        self._timer = None
        now = asyncio.get_running_loop().time()
        while self._ends:
            topic, when = next(iter(self._ends.items()))
            if when > now:
                self._start()
                return
            del self._ends[topic]
            self._end(topic)
