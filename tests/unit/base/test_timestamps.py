import pytest

from appliance.base.timestamps import TimestampError, parse_timestamp

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
