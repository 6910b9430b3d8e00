"""Parse durations such as `30s`, `5m`, `1.5h`, `90d`, `52w`. No clock."""

import re

_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}
_DURATION = re.compile(r"([0-9]{1,9}(?:\.[0-9]{1,9})?)([smhdw])")


def seconds_of(text: str) -> float | None:
    match = _DURATION.fullmatch(text)
    return None if match is None else float(match[1]) * _UNITS[match[2]]


def bounded_seconds(text: str, shortest: str, longest: str) -> float:
    """Return the seconds of a duration; both bounds are durations. Raises `ValueError`."""
    seconds = seconds_of(text)
    if seconds is None:
        raise ValueError(f"{text!r} is not a duration: write {shortest} to {longest}")
    if not (seconds_of(shortest) or 0.0) <= seconds <= (seconds_of(longest) or 0.0):
        raise ValueError(f"{text} is out of bounds: write {shortest} to {longest}")
    return seconds
