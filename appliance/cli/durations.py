"""Parse times on the command line: points in time, and durations such as `30s`, `5m`, `1.5h`, `90d`, `52w`."""

import re

import typer

from appliance.base import clock
from appliance.base.timestamps import TimestampError, parse_timestamp
from appliance.cli.output import usage_error

_UNITS = "smhdw"
_SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}
_SPAN = re.compile(r"([0-9]{1,9}(?:\.[0-9]{1,9})?)([smhdw])")
_NUMBER = re.compile(r"[0-9]{1,9}(?:\.[0-9]{1,9})?")


def seconds_of(text: str, units: str) -> float | None:
    found = _SPAN.fullmatch(text)
    if found is None or found[2] not in units or float(found[1]) <= 0:
        return None
    return float(found[1]) * _SECONDS[found[2]]


def bounded_span(
    option: str, text: str, shortest: str, longest: str, verb: str = "rosrv", *, bare: str = ""
) -> float:
    """Return seconds; both bounds are durations. Exit with status 2 for any other text.

    `bare` is the unit of a number without one, for an option that took such numbers in the last release.
    """
    text = _with_unit(option, text, bare)
    found = _SPAN.fullmatch(text)
    if found is None:
        raise usage_error(f"{option} {text!r} is not a duration: write {shortest} to {longest}", verb)
    seconds = float(found[1]) * _SECONDS[found[2]]
    least, most = (seconds_of(bound, _UNITS) or 0.0 for bound in (shortest, longest))
    if not least <= seconds <= most:
        raise usage_error(f"{option} {text} is out of bounds: write {shortest} to {longest}", verb)
    return seconds


def _with_unit(option: str, text: str, bare: str) -> str:
    if not bare or not _NUMBER.fullmatch(text):
        return text
    typer.echo(f"{option} {text} is now {option} {text}{bare}", err=True)
    return text + bare


def time_given(option: str, text: str, verb: str = "rosrv") -> int:
    """Return nanoseconds since the epoch. A time without a zone is in the machine's. Exit with status 2."""
    try:
        return parse_timestamp(text, clock.wall_ns(), None)
    except TimestampError as error:
        raise usage_error(f"{option}: {error}", verb) from None
