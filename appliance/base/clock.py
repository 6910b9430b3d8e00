"""The clocks of the machine: a monotonic one, the system time, and the time since the boot.

Every reading asks the source of the present context, which `using` replaces. Tasks and `asyncio.to_thread` keep
the source of their creator; a `threading.Thread` begins with the operating system's.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Protocol

_SECOND = 1e9


class ClockSource(Protocol):
    """A source of time; all readings are in nanoseconds."""

    def now_ns(self) -> int:
        """The monotonic time, which may begin at any number."""

    def wall_ns(self) -> int:
        """The time since the epoch, which people and time services set."""

    def since_boot_ns(self) -> int:
        """The time since the boot, which includes suspensions of the machine."""


class SystemClock:
    now_ns = staticmethod(time.monotonic_ns)
    wall_ns = staticmethod(time.time_ns)

    @staticmethod
    def since_boot_ns() -> int:
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


_SYSTEM = SystemClock()
_source: ContextVar[ClockSource] = ContextVar("clock", default=_SYSTEM)


@contextmanager
def using(source: ClockSource) -> Iterator[None]:
    before = _source.set(source)
    try:
        yield
    finally:
        _source.reset(before)


def source() -> ClockSource:
    return _source.get()


def now() -> float:
    """Return monotonic seconds, for durations, timeouts and the order of events."""
    return _source.get().now_ns() / _SECOND


def now_ns() -> int:
    return _source.get().now_ns()


def wall() -> float:
    """Return seconds since the epoch, for people and for dates that others have set."""
    return _source.get().wall_ns() / _SECOND


def wall_ns() -> int:
    return _source.get().wall_ns()


def utc_now() -> datetime:
    return datetime.fromtimestamp(wall(), UTC)


def since_boot() -> float:
    return _source.get().since_boot_ns() / _SECOND


def since_boot_ns() -> int:
    return _source.get().since_boot_ns()


_STEP = 1.0  # seconds; a time service corrects less without a step


class Began:
    """When something began: its date follows a step of the system clock, so that the age of the thing stays right.

    `at` is a date of the present system clock, in seconds since the epoch; None: now.
    """

    def __init__(self, at: float | None = None) -> None:
        self._date = wall() if at is None else at
        self._reading = since_boot() - (wall() - self._date)

    def date(self) -> float:
        """Return seconds since the epoch by the present system clock; without a step always the same number."""
        found = wall() - (since_boot() - self._reading)
        if abs(found - self._date) >= _STEP:
            self._date = found
        return self._date

    def text(self) -> str:
        """Return the date as RFC 3339, UTC, to the millisecond."""
        date = datetime.fromtimestamp(self.date(), UTC)
        return date.isoformat(timespec="milliseconds").replace("+00:00", "Z")
