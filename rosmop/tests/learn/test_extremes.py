import random

import pytest

from rosmop.learn.candidates import FEWEST_WINDOWS, upper


def test_a_bound_holds_on_ten_times_as_many_windows() -> None:
    chance = random.Random(1)  # noqa: S311  no secret
    passed = 0
    for _ in range(50):
        seen = [max(chance.gauss(0, 1) for _ in range(50)) for _ in range(24)]
        bound = upper(seen, 10_000)
        assert bound is not None
        passed += max(chance.gauss(0, 1) for _ in range(50 * 240)) > bound
    assert passed <= 2


def test_a_bound_is_not_far_beyond_what_is_possible() -> None:
    chance = random.Random(2)  # noqa: S311  no secret
    windows = [[chance.random() for _ in range(50)] for _ in range(24)]
    above, below = upper(map(max, windows), 1e6), upper((-min(window) for window in windows), 1e6)
    assert above is not None and max(map(max, windows)) <= above < 1.5
    assert below is not None and -0.5 < -below <= min(map(min, windows))


def test_a_value_reached_exactly_by_several_windows_is_the_bound() -> None:
    highs = [0.1, 0.3, 0.6, 0.2, 0.6, 0.5, 0.6, 0.4]
    assert upper(highs, 1e6, stops=True) == 0.6
    margin = upper(highs, 1e6)
    assert margin is not None and margin > 1.0


@pytest.mark.parametrize("count", [0, 1, FEWEST_WINDOWS - 1])
def test_too_few_windows_give_no_bound(count: int) -> None:
    assert upper([float(number) for number in range(count)], 100) is None
