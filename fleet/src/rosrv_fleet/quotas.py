"""Limit the bytes that each robot uploads in a day, and pause a robot after a rejected upload.

The used bytes are on the disk, so a restart gives no robot a new quota. They decrease evenly, and below 0: a robot
that was off may send its backlog faster.
"""

from collections.abc import Callable
from pathlib import Path

import msgspec
import structlog

from appliance.base import clock
from rosrv_fleet.config import Limits
from rosrv_fleet.robots import make_folder

_DAY_SECONDS = 86_400.0
_SAVED_DAYS = 7.0
_LEAST_BYTES = 64 << 10  # a segment costs at least this: files, markers and folders also cost
_LEAST_PAUSE = 1.0
_REST = 10.0  # after a refused segment, a robot pauses for this many times its processor time
_log = structlog.get_logger()


class OverQuotaError(Exception):
    """A robot has to wait for `seconds`."""

    def __init__(self, reason: str, seconds: float) -> None:
        super().__init__(reason)
        self.seconds = seconds


class UsedBytes(msgspec.Struct, frozen=True):
    """The bytes that a robot has used at `time` (seconds since the epoch). A negative number is a saved quota."""

    time: float = 0.0
    received: float = 0.0
    unpacked: float = 0.0


class RobotQuotas:
    """The quotas of robots in a folder. For each robot, only one call may run at a time."""

    def __init__(self, folder: Path, limits: Limits, clock: Callable[[], float] = clock.wall) -> None:
        make_folder(folder)
        self._folder = folder
        self._limits = limits
        self._clock = clock
        self._pauses: dict[str, float] = {}
        """The end of each robot's last pause."""

    def check(self, robot: str) -> None:
        rest = self._pauses.get(robot, 0.0) - clock.now()
        if rest > 0:
            raise OverQuotaError("uploads of this robot were refused: it has to pause", rest)
        used, limits = self._used(robot), self._limits
        for name, value, quota in (
            ("robot_bytes_per_day", used.received, limits.robot_bytes_per_day),
            ("robot_unpacked_bytes_per_day", used.unpacked, limits.robot_unpacked_bytes_per_day),
        ):
            if value >= quota:
                seconds = (value - quota) * _DAY_SECONDS / quota
                raise OverQuotaError(
                    f"this robot has used its limit of bytes for a day (limits.{name}), and continues in"
                    f" {seconds / 60:.0f} min; a backlog takes several days",
                    seconds,
                )

    def charge(self, robot: str, received: int, unpacked: int) -> None:
        used = self._used(robot)
        added = msgspec.structs.replace(
            used,
            received=used.received + max(received, _LEAST_BYTES),
            unpacked=used.unpacked + max(unpacked, _LEAST_BYTES),
        )
        self._save(robot, added)

    def refused(self, robot: str, seconds: float) -> None:
        self._pauses[robot] = clock.now() + max(_LEAST_PAUSE, _REST * seconds)

    def _save(self, robot: str, used: UsedBytes) -> None:
        making = self._folder / f"{robot}.new"
        making.write_bytes(msgspec.json.encode(used))
        making.rename(self._folder / f"{robot}.json")

    def _used(self, robot: str) -> UsedBytes:
        now = self._clock()
        try:
            used = msgspec.json.decode((self._folder / f"{robot}.json").read_bytes(), type=UsedBytes)
        except FileNotFoundError:
            return UsedBytes(now)
        except ValueError as error:
            _log.error("a robot's quota begins again: its file is damaged", robot=robot, reason=str(error))
            return UsedBytes(now)
        if used.time > now:  # the clock was ahead, and has been corrected
            used = msgspec.structs.replace(used, time=now)
            self._save(robot, used)
        days, limits = (now - used.time) / _DAY_SECONDS, self._limits
        return UsedBytes(
            now,
            _after(used.received, days, limits.robot_bytes_per_day),
            _after(used.unpacked, days, limits.robot_unpacked_bytes_per_day),
        )


def _after(used: float, days: float, quota: int) -> float:
    return max(-_SAVED_DAYS * quota, used - days * quota)
