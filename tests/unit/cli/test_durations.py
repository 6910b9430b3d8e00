import pytest
import typer

from appliance.base.durations import seconds_of
from appliance.cli.durations import bounded_span


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("30s", 30), ("5m", 300), ("1.5h", 5400), ("90d", 90 * 86_400), ("52w", 52 * 7 * 86_400)],
)
def test_a_duration_is_a_number_and_a_unit(text: str, seconds: float) -> None:
    assert seconds_of(text) == seconds


@pytest.mark.parametrize("text", ["", "5", "m", "-1m", "1y", "1e9d", "1 h", "٣m", "1m\n", "9999999999s"])
def test_an_invalid_duration_is_none(text: str) -> None:
    assert seconds_of(text) is None


@pytest.mark.parametrize(("text", "seconds"), [("1s", 1), ("0.5m", 30), ("1h", 3600)])
def test_a_duration_within_its_bounds_is_in_seconds(text: str, seconds: float) -> None:
    assert bounded_span("--within", text, "1s", "1h", "rosrv x") == seconds


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("0s", "0s is out of bounds"),
        ("61m", "61m is out of bounds"),
        ("7", "'7' is not a duration"),
        ("3 months", "'3 months' is not a duration"),
    ],
)
def test_a_duration_out_of_bounds_names_them(text: str, why: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit):
        bounded_span("--within", text, "1s", "1h", "rosrv x")
    assert capsys.readouterr().err == f"rosrv x: --within {why}: write 1s to 1h\n"
