"""Watch the free space on the log's disk."""

import os
from collections.abc import Callable
from pathlib import Path

_LOOK_SECONDS = 0.5
_AGAIN = 1.25  # times the reserve must be free before space is no longer scarce, so that alarms do not flap


class DiskSpace:
    """The free space on the disk of the log at `path`.

    `tell` gets the bytes left of the last `reserve` bytes, or None while more is free, and the free bytes.
    """

    def __init__(self, path: Path, reserve: int, tell: Callable[[int | None, int], None]) -> None:
        self._folder = path.parent
        self._reserve = reserve
        self._tell = tell
        self.due = float("-inf")
        self.left: int | None = None

    def look(self, now: float) -> bool | None:
        """Return True if space just became scarce, False if it just ceased to be, else None. Raises `OSError`."""
        self.due = now + _LOOK_SECONDS
        disk = os.statvfs(self._folder)
        free, before = disk.f_bavail * disk.f_frsize, self.left
        enough = self._reserve if before is None else self._reserve * _AGAIN
        self.left = None if free >= enough else min(free, self._reserve)
        self._tell(self.left, free)
        return None if (before is None) == (self.left is None) else self.left is not None

    @property
    def scarce(self) -> str | None:
        if self.left is None:
            return None
        return (
            f"{self._folder}: {self.left} bytes are free, below the reserve of {self._reserve} (audit.reserve_bytes):"
            " hosts that cause many records are slowed; make room, or let old records go (audit.retention_bytes)"
        )
