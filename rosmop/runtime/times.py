"""`ros::Time` and `ros::Duration` as integer nanoseconds, within the range that messages can hold."""

import math

from rosmop.runtime.action_context import FaultError

BILLION = 1_000_000_000
MAX_TIME = (1 << 32) * BILLION - 1
MIN_DURATION = -(1 << 31) * BILLION
MAX_DURATION = (1 << 31) * BILLION - 1


def time(nanoseconds: int, site: int) -> int:
    """Return the time, or fault where C++ throws because messages cannot hold it."""
    if 0 <= nanoseconds <= MAX_TIME:
        return nanoseconds
    raise FaultError(site, "the time is out of range: from 0 to 2^32 seconds")


def duration(nanoseconds: int, site: int) -> int:
    if MIN_DURATION <= nanoseconds <= MAX_DURATION:
        return nanoseconds
    raise FaultError(site, "the duration is out of range: 2^31 seconds")


def nanoseconds(seconds: float, site: int) -> int:
    if not math.isfinite(seconds) or abs(seconds) > 1 << 33:
        raise FaultError(site, f"{seconds} seconds are out of range")
    whole = math.floor(seconds)
    return whole * BILLION + math.floor((seconds - whole) * 1e9 + 0.5)


def scale(value: int, factor: float, site: int) -> int:
    return duration(nanoseconds(value / 1e9 * factor, site), site)


def with_part(value: int, part: bytes, new: int, site: int) -> int:
    seconds, rest = divmod(value, BILLION)
    result = new * BILLION + rest if part == b"sec" else seconds * BILLION + new
    return result if -MAX_TIME <= result <= MAX_TIME else time(result, site)
