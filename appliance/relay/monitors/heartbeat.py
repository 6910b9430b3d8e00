"""The heartbeat: a square wave that ends when a monitor in force cannot act.

Each relay checks itself every `PERIOD`, and writes into memory that the relays share when it last was fit. While all of
them are, the relay that carries the topic publishes an edge, and the first one writes an edge to the serial line. So an
edge needs each relay's own loop: after the death, the stop or a delay of one of them, no edge comes later than `PERIOD`
and `relay.late`. No process writes for another one.

The check also finds delays: its own, a turn of the loop that was too long, and those of messages. Without a heartbeat
and without a monitor that acts, it waits for `REST`, so that an idle relay sleeps. A relay that was not
fit, be it for a moment, is fit again after `REST`, so that a drive is not switched many times a second.
"""

import logging
import os
from collections.abc import Callable, Iterable
from typing import Protocol

from appliance.relay.loop import EventLoop
from appliance.relay.monitors.interceptor import Interceptor
from appliance.relay.relay_limits import RelayLimits

PERIOD = 0.05
"""The seconds between two edges: the wave has 10 Hz."""
REST = 1.0
"""The seconds without a cause before the edges go on."""
_EDGES = (b"\x55", b"\xaa")
_WORDS = 2  # of each relay: when it was fit (monotonic ns), and its monitors that act


class TimedTopic(Protocol):
    """A topic whose messages are timed."""

    topic: str

    def take_late(self) -> tuple[int, float]:
        """Return the late messages since the last call, and the longest delay in seconds."""


class Heartbeat:
    """One relay's part of the heartbeat. `publish(data)` returns without effect on a relay without its topic.

    `topics()` are the relayed topics, `unwritten()` says which stop waits for a subscriber, and `line_wanted()` asks
    the supervisor for the serial line.
    """

    def __init__(
        self,
        loop: EventLoop,
        limits: RelayLimits,
        interceptor: Interceptor,
        *,
        publish: Callable[[bytes], None],
        topics: Callable[[], Iterable[TimedTopic]],
        unwritten: Callable[[], str],
    ) -> None:
        self._loop, self._limits, self._interceptor = loop, limits, interceptor
        self._publish, self._topics, self._unwritten = publish, topics, unwritten
        self.line_wanted: Callable[[], None] = lambda: None
        self._late = limits.late / 1e3
        self._wanted = bool(limits.heartbeat or limits.heartbeat_line)
        self._index = 0
        self._shared = memoryview(bytearray(8 * _WORDS)).cast("q")
        self._line = -1
        self._asked = loop.clock()
        self._fit_from = self._asked + REST
        self._cause = "the relay has begun"
        self._edge = 0
        self._stops: str = ""
        self._due = loop.clock() + PERIOD
        loop.after(PERIOD, self._beat)

    def share(self, memory: memoryview, index: int) -> None:
        """Use memory that all relays share, as the one with this index."""
        self._shared, self._index = memory.cast("q"), index

    def use_line(self, descriptor: int) -> None:
        """Write to this serial line from now on."""
        self.close()
        self._line = descriptor

    def close(self) -> None:
        if self._line >= 0:
            os.close(self._line)
            self._line = -1

    def _beat(self) -> None:
        now = self._loop.clock()
        acting = self._interceptor.acting
        why = self._check(now)
        period = PERIOD if acting or self._wanted else REST
        self._due = now + period
        self._loop.after(period, self._beat)
        own = _WORDS * self._index
        self._interceptor.observations.unfit, self._interceptor.observations.acting = why, len(acting)
        self._shared[own + 1] = len(acting)
        self._shared[own] = 0 if why else int(now * 1e9)
        if why or not self._all_fit(now):
            return
        self._edge ^= 1
        if self._limits.heartbeat:
            self._publish(bytes([self._edge]))
        if self._line >= 0:
            self._write()

    def _check(self, now: float) -> str:
        """Return why this relay is not fit, or has not been for `REST`, or an empty text."""
        self._find_delays(now)
        observer = self._interceptor.observer
        failed = observer.take_failed()
        cause = failed or self._interceptor.unfit() or self._stop_waits() or self._line_lacks(now)
        if cause:
            self._cause, self._fit_from = cause, now + REST
        return self._cause if now < self._fit_from else ""

    def _find_delays(self, now: float) -> None:
        interceptor, observer = self._interceptor, self._interceptor.observer
        busy = max(now - self._due, self._loop.take_longest())
        if busy > self._late:
            observer.count_times(interceptor.acting, "the relay was busy, so a tick or a message", 1, busy)
        for topic in self._topics():
            late, longest = topic.take_late()
            if late:
                what = f"a message of {topic.topic}"
                observer.count_times(interceptor.judges(topic.topic), what, 0, longest, late)

    def _stop_waits(self) -> str:
        """Return which stop has waited since the last check for a subscriber to take it."""
        before, self._stops = self._stops, self._unwritten()
        return self._stops if self._stops == before else ""

    def _line_lacks(self, now: float) -> str:
        if not self._limits.heartbeat_line or self._index or self._line >= 0:
            return ""
        if now - self._asked >= REST:
            self._asked = now
            self.line_wanted()
        return f"{self._limits.heartbeat_line} cannot be opened or written to"

    def _all_fit(self, now: float) -> bool:
        oldest = (now - PERIOD - self._late) * 1e9
        return min(self._shared[::_WORDS]) >= oldest and any(self._shared[1::_WORDS])

    def _write(self) -> None:
        try:
            os.write(self._line, _EDGES[self._edge])
        except OSError as error:  # BlockingIOError: its buffer is full
            line = self._limits.heartbeat_line
            logging.getLogger(__name__).error("the heartbeat cannot be written to %s: %s", line, error)
            self.close()
