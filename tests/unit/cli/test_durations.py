import pytest

from appliance.cli.durations import seconds_of


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("30s", 30), ("5m", 300), ("1.5h", 5400), ("90d", 90 * 86_400), ("52w", 52 * 7 * 86_400)],
)
def test_a_duration_is_a_number_and_a_unit(text: str, seconds: float) -> None:
    assert seconds_of(text, "smhdw") == seconds


@pytest.mark.parametrize(
    "text", ["", "5", "m", "-1m", "0s", "0.0h", "1y", "1e9d", "1 h", "٣m", "1m\n", "9999999999s"]
)
def test_an_invalid_duration_is_none(text: str) -> None:
    assert seconds_of(text, "smhdw") is None


def test_only_the_allowed_units_count() -> None:
    assert seconds_of("1w", "smh") is None
