"""Make record ids: sortable by time, unique, and ascending even if the clock is set back.

The last 4 of the 20 hexadecimal digits are random, and differ between sources.
"""

import re
import secrets
import threading
from collections.abc import Callable

from appliance.base import clock

ID_LENGTH = 20
ID_OR_SEQUENCE = re.compile("[0-9a-f]{1,20}")
"""The id of a record, or its number in the log."""
_TIME_DIGITS = 16


class IdSource:
    """Each id is greater than the previous id and than `after`. Thread-safe."""

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
        """Return by how many seconds the last id is ahead of the clock, which was set back."""
        return max(0.0, (self._last - self._clock()) / 1e9)

    def raise_floor(self, after: str) -> None:
        if after:
            with self._lock:
                self._last = max(self._last, int(after[:_TIME_DIGITS], 16))
