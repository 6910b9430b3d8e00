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
