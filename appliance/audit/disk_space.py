"""Room on the log's disk: looks now and then, and tells when only the reserve is left."""

import os
import time
from collections.abc import Callable
from pathlib import Path

_LOOK_SECONDS = 0.5
_AGAIN = 1.25  # of the reserve must be free until there is room again: no alarm for each byte


class Room:
    """The room for the log at `path`, of which the last `reserve` bytes are spared.

    `tell(left)` hears, at each look, how much is left of the reserve; None while there is more than that.
    """

    def __init__(self, path: Path, reserve: int, tell: Callable[[int | None], None]) -> None:
        self._folder = path.parent
        self._reserve = reserve
        self._tell = tell
        self._looked = float("-inf")
        self.left: int | None = None

    def look(self) -> bool | None:
        """Look, if it is time to: True when the room has just become scarce, False when it is there again, else None.

        Raises `OSError`.
        """
        now = time.monotonic()
        if now - self._looked < _LOOK_SECONDS:
            return None
        self._looked = now
        disk = os.statvfs(self._folder)
        free, before = disk.f_bavail * disk.f_frsize, self.left
        enough = self._reserve if before is None else self._reserve * _AGAIN
        self.left = None if free >= enough else min(free, self._reserve)
        self._tell(self.left)
        return None if (before is None) == (self.left is None) else self.left is not None

    @property
    def scarce(self) -> str | None:
        """What to say of it while only the reserve is left."""
        if self.left is None:
            return None
        return (
            f"{self._folder}: {self.left} bytes are free, below the reserve of {self._reserve} (audit.reserve_bytes):"
            " hosts that cause many records are slowed; make room, or let old records go (audit.retention_bytes)"
        )
