"""Tests of moments on the command line."""

import pytest

from appliance.audit.timestamps import MomentError, parse_moment

_NOW = 1_800_000_000_000_000_000
_SECOND = 1_000_000_000


@pytest.mark.parametrize(
    ("text", "moment"),
    [
        ("30s", _NOW - 30 * _SECOND),
        ("5m", _NOW - 300 * _SECOND),
        ("1h", _NOW - 3600 * _SECOND),
        ("1.5h", _NOW - 5400 * _SECOND),
        ("2d", _NOW - 172_800 * _SECOND),
        ("1w", _NOW - 604_800 * _SECOND),
        ("2026-03-01", 1_772_323_200 * _SECOND),
        ("2026-03-01T12:00:00Z", 1_772_366_400 * _SECOND),
        ("2026-03-01 12:00", 1_772_366_400 * _SECOND),
        ("2026-03-01T13:00:00+01:00", 1_772_366_400 * _SECOND),
        ("2026-03-01T12:00:00.000000007Z", 1_772_366_400 * _SECOND + 7),
        ("2026-03-01T12:00:00.5Z", 1_772_366_400 * _SECOND + 500_000_000),
    ],
)
def test_moments(text: str, moment: int) -> None:
    """Durations count back from now; dates without a zone are UTC; nanoseconds are kept."""
    assert parse_moment(text, _NOW) == moment


@pytest.mark.parametrize(
    ("text", "moment"),
    [("0001-01-01", -(1 << 63)), ("999999999w", -(1 << 63)), ("9999-12-31T23:59:59.9Z", (1 << 63) - 1)],
)
def test_a_moment_beyond_all_times_of_the_log_is_its_first_or_last(text: str, moment: int) -> None:
    """Whoever compares it with a record's, or sends it on, has a number of 64 bits."""
    assert parse_moment(text, _NOW) == moment


@pytest.mark.parametrize(
    "text", ["", "yesterday", "\u0661h", "1y", "-1h", "1", "2026-13-01", "25:00", "9" * 400 + "h"]
)
def test_no_moment(text: str) -> None:
    """What is no moment is an error that says what is."""
    with pytest.raises(MomentError, match="1h, 2d"):
        parse_moment(text, _NOW)
