"""Records that did not fit into the queue while the log could not be written: how many, from when to when."""

import threading
from typing import Any

from appliance.audit.record import Record


class Lost:
    """Counts them, on any thread."""

    def __init__(self) -> None:
        self.count = 0
        self._first = self._last = 0
        self._lock = threading.Lock()

    def add(self, record: Record) -> None:
        """One more."""
        with self._lock:
            self._first = self._first if self.count else record.time
            self._last = record.time
            self.count += 1

    def take(self) -> dict[str, Any]:
        """The detail of the record that says so; counting begins anew."""
        with self._lock:
            detail = {"count": self.count, "first_time": self._first, "last_time": self._last}
            self.count = 0
            return detail
