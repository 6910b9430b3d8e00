"""Note when each appliance of a robot was last heard: when it pushed a segment, or reported that it had none to push.

An appliance that is shut down cleanly reports this. The files, of which the modification time and the content are
read, survive restarts, and commands see them. Silence is measured on the monotonic clock, so that a correction of the
collector's clock makes no robot silent, and hides none.
"""

import contextlib
import os
from pathlib import Path
from typing import NamedTuple

from appliance.base import clock
from rosrv_fleet.enrolment import Robot
from rosrv_fleet.robots import make_folder

_SECOND = 1_000_000_000
_OFF = b"off"


class LastSign(NamedTuple):
    """The last sign of life of an appliance: `at` in seconds since the epoch, `now` in monotonic ones (0: unknown)."""

    at: float
    off: bool
    now: float = 0.0


class RobotPresence:
    """The last signs of robots. Only the process that hears them knows their monotonic time."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._heard: dict[tuple[str, str], LastSign] = {}

    def heard(self, robot: str, appliance: str, *, off: bool = False) -> None:
        now = clock.wall_ns()
        self._heard[robot, appliance] = LastSign(now / _SECOND, off, clock.now())
        # On a full disk the sign stays in memory; health reports the disk.
        with contextlib.suppress(OSError):
            file = self._folder / robot / appliance
            make_folder(file.parent)
            file.touch(mode=0o600)
            file.write_bytes(_OFF if off else b"")
            os.utime(file, ns=(now, now))

    def off(self, robot: Robot) -> set[str]:
        """Return the appliances of a robot that were shut down cleanly, and were not heard since."""
        signs = {name: self.last(robot.name, name) for name in robot.connecting}
        return {name for name, sign in signs.items() if sign is not None and sign.off}

    def is_off(self, robot: Robot) -> bool:
        """Return whether all appliances of a robot are off: a pair works with one of them."""
        return self.off(robot) == set(robot.connecting) != set()

    def last(self, robot: str, appliance: str) -> LastSign | None:
        found = self._heard.get((robot, appliance))
        if found is not None:
            return found
        file = self._folder / robot / appliance
        try:
            return LastSign(file.stat().st_mtime, file.read_bytes() == _OFF)
        except OSError:
            return None
