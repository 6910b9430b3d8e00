"""Note when each appliance of a robot was last heard: when it pushed a segment, or reported that it had none to push.

The times are modification times of files, so they survive restarts, and commands see them.
"""

import contextlib
import os
from pathlib import Path

from appliance.base import clock
from rosrv_fleet.robots import make_folder

_SECOND = 1_000_000_000


class RobotPresence:
    """The times at which robots were heard, in seconds since the epoch."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._heard: dict[tuple[str, str], float] = {}
        self.began = clock.wall()
        """The time since which this process could hear robots."""

    def heard(self, robot: str, appliance: str) -> None:
        now = clock.wall_ns()
        self._heard[robot, appliance] = now / _SECOND
        # On a full disk the time stays in memory; health reports the disk.
        with contextlib.suppress(OSError):
            file = self._folder / robot / appliance
            make_folder(file.parent)
            file.touch(mode=0o600)
            os.utime(file, ns=(now, now))

    def last(self, robot: str, appliance: str) -> float | None:
        found = self._heard.get((robot, appliance))
        if found is not None:
            return found
        try:
            return (self._folder / robot / appliance).stat().st_mtime
        except OSError:
            return None
