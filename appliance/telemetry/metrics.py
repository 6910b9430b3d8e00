"""Keep the counters of RVMaster.

Counting costs a few additions per request and no formatting.
"""

import bisect
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field

from appliance.base import clock
from appliance.base.metric import BOUNDS

_SECONDS = 60


class LastMinute:
    """Counts of the last 60 seconds, one for each second and name; `clock` returns seconds and is never set back.

    The caller limits the number of names.
    """

    def __init__(self, clock: Callable[[], float] = clock.now) -> None:
        self._clock = clock
        self._seconds: deque[tuple[int, Counter[str]]] = deque(maxlen=_SECONDS)

    def add(self, name: str, number: int = 1) -> None:
        second = int(self._clock())
        if not self._seconds or self._seconds[-1][0] != second:
            self._seconds.append((second, Counter()))
        self._seconds[-1][1][name] += number

    def counts(self) -> dict[str, int]:
        """Return the counts, without names that had no event."""
        oldest = int(self._clock()) - _SECONDS
        total: Counter[str] = Counter()
        for second, counts in self._seconds:
            if second > oldest:
                total.update(counts)
        return dict(total)


@dataclass(slots=True)
class Histogram:
    """Durations by upper bound; the last entry of `counts` is for those above all `BOUNDS`."""

    counts: list[int] = field(default_factory=lambda: [0] * (len(BOUNDS) + 1))
    sum: float = 0.0

    def observe(self, seconds: float) -> None:
        self.counts[bisect.bisect_left(BOUNDS, seconds)] += 1
        self.sum += seconds

    def values(self) -> tuple[list[int], float]:
        return self.counts, self.sum


class Meter:
    """The counters of RVMaster's events since its start, and of the last minute.

    `denied_hosts` has the unknown hosts together, as "".
    """

    def __init__(self) -> None:
        self.decisions: Counter[tuple[str, str]] = Counter()
        self.decision_seconds = Histogram()
        self.calls: dict[str, Histogram] = {}
        self.denied = LastMinute()
        self.denied_hosts = LastMinute()
        self.dropped = LastMinute()

    def decided(self, category: str, outcome: str, seconds: float, host: str) -> None:
        self.decisions[category, outcome] += 1
        if outcome == "deny":
            self.denied.add(category)
            self.denied_hosts.add(host)
        self.decision_seconds.observe(seconds)

    def called(self, call: str, seconds: float) -> None:
        """Count a call; `call` is a name of the call table, never text from a client."""
        histogram = self.calls.get(call)
        if histogram is None:
            histogram = self.calls[call] = Histogram()
        histogram.observe(seconds)
