"""Count the events of the last minute by name, for the status."""

from collections import Counter, deque
from collections.abc import Callable

from appliance.base import clock

_SECONDS = 60


class LastMinute:
    """Counts of the last 60 seconds, one for each second and name; `clock` returns seconds and is never set back.

    The caller limits the number of names.
    """

    def __init__(self, clock: Callable[[], float] = clock.now) -> None:
        self._clock = clock
        self._seconds: deque[tuple[int, Counter[str]]] = deque(maxlen=_SECONDS)

    def add(self, name: str, number: int = 1) -> None:
        """Count events that happen now."""
        second = int(self._clock())
        if not self._seconds or self._seconds[-1][0] != second:
            self._seconds.append((second, Counter()))
        self._seconds[-1][1][name] += number

    def counts(self) -> dict[str, int]:
        """Return the number of events in the last minute for each name that had any."""
        oldest = int(self._clock()) - _SECONDS
        total: Counter[str] = Counter()
        for second, counts in self._seconds:
            if second > oldest:
                total.update(counts)
        return dict(total)
