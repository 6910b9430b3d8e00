"""Record ids: sortable by time, unique, and growing even when the clock is set back.

An id is 20 lower-case hexadecimal characters: nanoseconds since the epoch (16) and four random ones of this
source, so that ids made by two processes in the same nanosecond differ. The time part never stands still and
never goes back: with the clock set back it counts on from the last id. Over a restart the last id of the log
is the floor (`after`), which `AuditLog.ids` sees to.
"""

import secrets
import threading
import time
from collections.abc import Callable

ID_LENGTH = 20
_TIME_DIGITS = 16


class IdSource:
    """Makes ids, each greater than the one before and than `after`; safe to use from several threads."""

    def __init__(self, after: str = "", clock: Callable[[], int] = time.time_ns) -> None:
        self._last = int(after[:_TIME_DIGITS], 16) if after else 0
        self._suffix = secrets.token_hex((ID_LENGTH - _TIME_DIGITS) // 2)
        self._clock = clock
        self._lock = threading.Lock()

    def next(self) -> str:
        """The next id."""
        with self._lock:
            now = self._clock()
            self._last = now if now > self._last else self._last + 1
            return f"{self._last:016x}{self._suffix}"

    @property
    def ahead(self) -> float:
        """By how many seconds the last id is later than the clock, which was set back then; else 0."""
        return max(0.0, (self._last - self._clock()) / 1e9)

    def raise_floor(self, after: str) -> None:
        """Make only ids greater than `after` from now on."""
        if after:
            with self._lock:
                self._last = max(self._last, int(after[:_TIME_DIGITS], 16))
