"""Each guard against a naive model of its page: no trace gets more than the page permits, and an honest one moves."""

from collections.abc import Callable

import pytest

from tests.support.examples import seeds_of_night
from tests.unit.features.guards import evidence_oracles, limit_oracles, oracles, place_oracles

AT_GATE = 15
AT_NIGHT = 2000
ORACLES: tuple[Callable[[int], None], ...] = (
    oracles.watchdog, oracles.enabling_device, oracles.stop_button, oracles.two_hands, oracles.operating_mode,
    limit_oracles.speed_by_norm, limit_oracles.acceleration, limit_oracles.jerk, limit_oracles.finite_values,
    limit_oracles.message_rate, evidence_oracles.sensor, evidence_oracles.cross_check, evidence_oracles.arming,
    place_oracles.fence, place_oracles.separation,
)  # fmt: skip


@pytest.mark.timeout(120)
@pytest.mark.parametrize("oracle", ORACLES)
def test_a_guard_does_what_its_page_says(oracle: Callable[[int], None]) -> None:
    for seed in range(AT_GATE):
        oracle(seed)


@pytest.mark.nightly
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("oracle", ORACLES)
def test_a_guard_does_what_its_page_says_at_night(oracle: Callable[[int], None]) -> None:
    for seed in seeds_of_night(AT_NIGHT):
        try:
            oracle(seed)
        except AssertionError as error:
            error.add_note(f"in the trace {seed}")
            raise


def test_a_guard_of_another_number_is_found() -> None:
    """The oracles can fail: a watchdog that waits longer than the oracle believes is found."""
    found = 0
    for seed in range(20):
        try:
            oracles.watchdog(seed, slower=2)
        except AssertionError:
            found += 1
    assert found > 10
