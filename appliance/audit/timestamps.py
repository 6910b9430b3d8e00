"""Moments as people give them, on the command line and over REST: `1h` ago, a date, or RFC 3339."""

import re
from datetime import UTC, datetime

_SECOND = 1_000_000_000
_UNITS = {"s": 1, "m": 60, "h": 3600, "d": 86_400, "w": 604_800}


class MomentError(ValueError):
    """A moment that cannot be understood; the message says what can."""


def parse_moment(text: str, now: int) -> int:
    """Nanoseconds since the epoch. `now` is what `1h` is counted back from; without a zone it is UTC.

    What is before or after all times that the log can have is the first or last of them. Raises `MomentError`.
    """
    ago = re.fullmatch(r"(\d{1,9}(?:\.\d{1,9})?)([smhdw])", text, re.ASCII)
    if ago is not None:
        return _bounded(now - int(float(ago[1]) * _UNITS[ago[2]] * _SECOND))
    # datetime knows microseconds only; the log's times have nanoseconds and can be given as they are shown.
    fraction = re.search(r"\.(\d{1,9})", text)
    whole = text if fraction is None else text.replace(fraction[0], "", 1)
    try:
        moment = datetime.fromisoformat(whole)
    except ValueError as error:
        raise MomentError(
            f"'{text}' is no moment: give 30s, 5m, 1h, 2d or 1w (that long ago), 2026-03-01, or"
            " 2026-03-01T12:00:00Z"
        ) from error
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    nanoseconds = 0 if fraction is None else int(fraction[1].ljust(9, "0"))
    return _bounded(int(moment.timestamp()) * _SECOND + nanoseconds)


def _bounded(time: int) -> int:
    return max(-(1 << 63), min(time, (1 << 63) - 1))
