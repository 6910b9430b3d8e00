"""Parse the times that people give on the command line and over REST: `1h` ago, a date, or RFC 3339."""

import re
from datetime import UTC, datetime, timedelta, tzinfo

from appliance.base import clock

_SECOND = 1_000_000_000
_IN_UTC = re.compile(r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(\.\d{1,9})?)(?:Z|\+00:00)")
_UNITS = {"s": 1, "m": 60, "h": 3600, "d": 86_400, "w": 604_800}


class TimestampError(ValueError):
    """The text is not a time; the message lists the valid forms."""


def parse_timestamp(text: str, now: int, zone: tzinfo | None = UTC) -> int:
    """Return nanoseconds since the epoch; outside the log's range, it is the nearest end.

    A time that names no zone is in `zone`; None is the machine's. Raises `TimestampError`.
    """
    ago = re.fullmatch(r"(\d{1,9}(?:\.\d{1,9})?)([smhdw])", text, re.ASCII)
    if ago is not None:
        return _bounded(now - int(float(ago[1]) * _UNITS[ago[2]] * _SECOND))
    try:
        return parse_date(_date(text, now, zone), zone)
    except ValueError as error:
        raise TimestampError(
            f"'{text}' is not a valid time: use 30s, 5m, 1h, 2d or 1w (that long ago), 10:32, yesterday,"
            " 'yesterday 10:32', 2026-03-01, or 2026-03-01T12:00:00Z"
        ) from error


def _date(text: str, now: int, zone: tzinfo | None) -> str:
    match = re.fullmatch(
        r"(?:(today|yesterday)(?:[ T](?=.)|$))?(?:(\d\d:\d\d(?::\d\d)?)(Z|[+-]\d\d:\d\d)?)?", text, re.ASCII
    )
    if not text or match is None:
        return text
    day, time, offset = match.groups()
    named = zone if offset is None else datetime.fromisoformat(f"2000-01-01T00:00{offset}").tzinfo
    moment = datetime.fromtimestamp(now // _SECOND, UTC).astimezone(named)
    later = day is None and time > moment.strftime("%H:%M:%S")
    date = (moment - timedelta(days=day == "yesterday" or later)).date().isoformat()
    return f"{date} {time}{offset or ''}" if time else date


def parse_date(text: str, zone: tzinfo | None = UTC) -> int:
    """Return nanoseconds since the epoch; `zone` as for `parse_timestamp`. Raises `ValueError`."""
    # datetime keeps only microseconds. The log prints nanoseconds, and every printed time must be valid input.
    fraction = re.search(r"\.(\d{1,9})", text)
    whole = text if fraction is None else text.replace(fraction[0], "", 1)
    moment = datetime.fromisoformat(whole)
    if moment.tzinfo is None:
        moment = moment.astimezone() if zone is None else moment.replace(tzinfo=zone)
    nanoseconds = 0 if fraction is None else int(fraction[1].ljust(9, "0"))
    return _bounded(int(moment.timestamp()) * _SECOND + nanoseconds)


def local_text(time: int, *, digits: int = 9) -> str:
    """Return nanoseconds since the epoch as RFC 3339 in the machine's zone, with its offset; out of range as `@…ns`.

    `digits` is the number of decimals of a second.
    """
    seconds, fraction = divmod(time, _SECOND)
    try:
        moment = datetime.fromtimestamp(seconds, UTC).astimezone()
    except (OverflowError, ValueError, OSError):
        return f"@{time}ns"
    decimals = f".{fraction:09d}"[: digits + 1] if digits else ""
    return f"{moment:%Y-%m-%dT%H:%M:%S}{decimals}{_offset(moment)}"


def local_minute(seconds: float) -> str:
    """Return a time as date and minute in the machine's zone, with its offset."""
    moment = datetime.fromtimestamp(seconds, UTC).astimezone()
    return f"{moment:%Y-%m-%d %H:%M}{_offset(moment)}"


def in_local_zone(text: str) -> str:
    """Return a sentence of the appliance with its times, which are in UTC, in the machine's zone."""
    return _IN_UTC.sub(lambda found: local_text(parse_date(found[1]), digits=len(found[2] or ".") - 1), text)


def _offset(moment: datetime) -> str:
    offset = moment.isoformat()[-6:]
    return "Z" if offset == "+00:00" else offset


def _bounded(time: int) -> int:
    return max(-(1 << 63), min(time, (1 << 63) - 1))


def age(since: float, now: float | None = None) -> str:
    seconds = max(0, int((clock.wall() if now is None else now) - since))
    days, rest = divmod(seconds, 86_400)
    hours, rest = divmod(rest, 3_600)
    minutes, left = divmod(rest, 60)
    if days:
        return f"{days} d {hours} h"
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {left} s" if minutes else f"{left} s"
