"""Parse times on the command line: points in time, and durations such as `30s`, `5m`, `1.5h`, `90d`, `52w`."""

import re

from appliance.cli.output import usage_error

_SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}
_SPAN = re.compile(r"([0-9]{1,9}(?:\.[0-9]{1,9})?)([smhdw])")


def seconds_of(text: str, units: str) -> float | None:
    found = _SPAN.fullmatch(text)
    if found is None or found[2] not in units or float(found[1]) <= 0:
        return None
    return float(found[1]) * _SECONDS[found[2]]


def span_given(option: str, text: str, spans: str, verb: str = "rosrv") -> float:
    """Return seconds; `spans` lists one example of each accepted unit. Exit with status 2 for any other text."""
    seconds = seconds_of(text, "".join(filter(str.isalpha, spans.replace(" or ", ""))))
    if seconds is None:
        raise usage_error(f"{option} {text!r} is not a time: write {spans}", verb)
    return seconds
