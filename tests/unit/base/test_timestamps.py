import time
from collections.abc import Iterator

import pytest

from appliance.base.timestamps import (
    TimestampError,
    in_local_zone,
    local_minute,
    local_text,
    parse_timestamp,
)

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
        ("08:00", 1_800_000_000 * _SECOND),  # now, on 2027-01-15
        ("07:59:58", 1_799_999_998 * _SECOND),
        ("08:00:01", 1_799_913_601 * _SECOND),  # yesterday
        ("today", 1_799_971_200 * _SECOND),
        ("today 07:30", 1_799_998_200 * _SECOND),
        ("yesterday", 1_799_884_800 * _SECOND),
        ("yesterday 10:32", 1_799_922_720 * _SECOND),
        ("2026-03-01", 1_772_323_200 * _SECOND),
        ("2026-03-01T12:00:00Z", 1_772_366_400 * _SECOND),
        ("2026-03-01 12:00", 1_772_366_400 * _SECOND),
        ("2026-03-01T13:00:00+01:00", 1_772_366_400 * _SECOND),
        ("2026-03-01T12:00:00.000000007Z", 1_772_366_400 * _SECOND + 7),
        ("2026-03-01T12:00:00.5Z", 1_772_366_400 * _SECOND + 500_000_000),
    ],
)
def test_times(text: str, moment: int) -> None:
    assert parse_timestamp(text, _NOW) == moment


@pytest.mark.parametrize(
    ("text", "moment"),
    [("0001-01-01", -(1 << 63)), ("999999999w", -(1 << 63)), ("9999-12-31T23:59:59.9Z", (1 << 63) - 1)],
)
def test_a_time_out_of_range_is_clamped(text: str, moment: int) -> None:
    assert parse_timestamp(text, _NOW) == moment


@pytest.mark.parametrize(
    "text",
    [
        "",
        "tomorrow",
        "yesterday 25:00",
        "today ",
        "\u0661h",
        "1y",
        "-1h",
        "1",
        "2026-13-01",
        "25:00",
        "9" * 400 + "h",
    ],
)
def test_an_invalid_time_is_an_error(text: str) -> None:
    with pytest.raises(TimestampError, match="1h, 2d"):
        parse_timestamp(text, _NOW)


@pytest.fixture
def berlin(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The machine's zone: one hour ahead of UTC in January, two in July."""
    monkeypatch.setenv("TZ", "CET-1CEST,M3.5.0,M10.5.0/3")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.usefixtures("berlin")
@pytest.mark.parametrize(
    ("text", "moment"),
    [
        ("08:00", 1_799_996_400 * _SECOND),  # it is 09:00 there
        ("08:00Z", 1_800_000_000 * _SECOND),
        ("10:00+02:00", 1_800_000_000 * _SECOND),
        ("yesterday 09:00", 1_799_913_600 * _SECOND),
        ("today", 1_799_967_600 * _SECOND),
        ("2026-07-01 12:00", 1_782_900_000 * _SECOND),
        ("2026-07-01T12:00:00Z", 1_782_907_200 * _SECOND),
        ("1h", _NOW - 3600 * _SECOND),
    ],
)
def test_a_time_without_a_zone_is_in_the_machines(text: str, moment: int) -> None:
    assert parse_timestamp(text, _NOW, None) == moment


@pytest.mark.usefixtures("berlin")
@pytest.mark.parametrize("moment", [_NOW, _NOW + 7, 1_782_900_000 * _SECOND])
def test_a_printed_time_has_its_offset_and_is_read_again(moment: int) -> None:
    assert local_text(moment)[-6:] in ("+01:00", "+02:00")
    assert parse_timestamp(local_text(moment), _NOW, None) == moment
    assert parse_timestamp(local_text(moment), _NOW) == moment


@pytest.mark.usefixtures("berlin")
def test_times_in_sentences_of_the_appliance_are_in_the_machines_zone() -> None:
    text = "blocked until 2027-01-15T08:00:00+00:00, since 2026-07-01 10:00:00.25Z: rosrv host blocks"
    assert in_local_zone(text) == (
        "blocked until 2027-01-15T09:00:00+01:00, since 2026-07-01T12:00:00.25+02:00: rosrv host blocks"
    )
    assert local_minute(1_800_000_000) == "2027-01-15 09:00+01:00"
    assert in_local_zone("node 2027-01-15T08:00:00 says nothing") == "node 2027-01-15T08:00:00 says nothing"


def test_in_utc_a_printed_time_ends_with_z() -> None:
    assert local_text(_NOW, digits=0) == "2027-01-15T08:00:00Z"
