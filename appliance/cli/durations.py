"""Parse times on the command line: points in time, and durations such as `30s`, `5m`, `1.5h`, `90d`, `52w`."""

from appliance.base import clock
from appliance.base.durations import bounded_seconds
from appliance.base.timestamps import TimestampError, parse_timestamp
from appliance.cli.output import usage_error


def bounded_span(option: str, text: str, shortest: str, longest: str, verb: str = "rosrv") -> float:
    """Return seconds; both bounds are durations. Exit with status 2 for any other text."""
    try:
        return bounded_seconds(text, shortest, longest)
    except ValueError as error:
        raise usage_error(f"{option} {error}", verb) from None


def time_given(option: str, text: str, verb: str = "rosrv") -> int:
    """Return nanoseconds since the epoch. A time without a zone is in the machine's. Exit with status 2."""
    try:
        return parse_timestamp(text, clock.wall_ns(), None)
    except TimestampError as error:
        raise usage_error(f"{option}: {error}", verb) from None
