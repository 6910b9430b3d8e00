"""The latest changes of the state, kept in memory for one consumer."""

import threading
from collections import deque
from collections.abc import Callable, Sequence
from itertools import islice

from appliance.store.changes import Encoded


class ChangeFeed:
    """The changes after the number `before`, in order: at most `room` bytes, but always the last one.

    A consumer that lacks older ones needs a copy of the whole state. `changed` is called in the thread that made
    a change. Any thread may use this class.
    """

    def __init__(self, before: int, changed: Callable[[], None], room: int) -> None:
        self._before = before
        self._changed = changed
        self._room = room
        self._size = 0
        self._changes: deque[Encoded] = deque()
        self._lock = threading.Lock()

    def add(self, changes: Sequence[Encoded]) -> None:
        """Add changes, whose numbers continue without a gap."""
        with self._lock:
            self._changes += changes
            self._size += sum(len(change.body) for change in changes)
            self._shrink()
        self._changed()

    def keep(self, room: int) -> None:
        with self._lock:
            self._room = room
            self._shrink()

    def after(self, number: int, most: int) -> list[Encoded] | None:
        """Return the changes after `number`: at most `most` bytes, but at least one change. None: some are missing."""
        with self._lock:
            skipped = number - self._before
            if not 0 <= skipped <= len(self._changes):
                return None
            found: list[Encoded] = []
            for change in islice(self._changes, skipped, None):
                most -= len(change.body)
                if found and most < 0:
                    break
                found.append(change)
            return found

    def release(self, number: int) -> None:
        with self._lock:
            while self._changes and self._before < number:
                self._drop_oldest()

    @property
    def size(self) -> int:
        return self._size

    def _shrink(self) -> None:
        while self._size > self._room and len(self._changes) > 1:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        self._before, body = self._changes.popleft()
        self._size -= len(body)
