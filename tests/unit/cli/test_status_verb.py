from appliance.base.timestamps import age
from appliance.cli.status_verb import shorten


def test_ages_are_two_units() -> None:
    now = 1_000_000.0
    found = [age(now - back, now) for back in (-5, 3, 61, 3600, 90_000)]
    assert found == ["0 s", "3 s", "1 min 1 s", "1 h 0 min", "1 d 1 h"]


def test_few_lines_are_not_shortened() -> None:
    assert shorten(["a", "b"], 2) == ["a", "b"]
    assert shorten(["a", "b", "c"], 2) == ["a", "and 2 more: rosrv status --json"]
