"""Make record ids: sortable by time, unique, and ascending even if the clock is set back.

An id has 20 lower-case hexadecimal characters: 16 for nanoseconds since the epoch, and 4 random ones. The random ones
differ between sources. The time part always grows: if the clock is set back, and after a restart, it continues from
the last id.
"""

import secrets
import threading
from collections.abc import Callable

from appliance.base import clock

ID_LENGTH = 20
_TIME_DIGITS = 16


class IdSource:
    """A source of ids, each greater than the previous id and than `after`; thread-safe."""

    def __init__(self, after: str = "", clock: Callable[[], int] = clock.wall_ns) -> None:
        self._last = int(after[:_TIME_DIGITS], 16) if after else 0
        self._suffix = secrets.token_hex((ID_LENGTH - _TIME_DIGITS) // 2)
        self._clock = clock
        self._lock = threading.Lock()

    def next(self) -> str:
        with self._lock:
            now = self._clock()
            self._last = now if now > self._last else self._last + 1
            return f"{self._last:016x}{self._suffix}"

    @property
    def ahead(self) -> float:
        """Return by how many seconds the last id is later than the clock (which was set back), or 0."""
        return max(0.0, (self._last - self._clock()) / 1e9)

    def raise_floor(self, after: str) -> None:
        if after:
            with self._lock:
                self._last = max(self._last, int(after[:_TIME_DIGITS], 16))
