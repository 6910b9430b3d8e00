"""No history of a whole world breaks a promise; `python -m tests.world --seed N` replays one."""

import os

import pytest

from tests.world.mutants import MUTANTS, first_broken
from tests.world.world import run

_SEEDS = 6000 if os.environ.get("TESTS_EXAMPLES") == "all" else 200
_IN_ONE_CASE = 50


@pytest.mark.parametrize("first", range(0, _SEEDS, _IN_ONE_CASE))
def test_no_history_breaks_a_promise(first: int) -> None:
    """Each of these seeds is a history of faults."""
    for seed in range(first, first + _IN_ONE_CASE):
        try:
            run(seed)
        except AssertionError as error:
            error.add_note(f"replay it with: python -m tests.world --seed {seed}")
            raise


def test_a_seed_gives_the_same_history_again() -> None:
    """A finding can be repeated."""
    traces: list[list[str]] = [[], []]
    for trace in traces:
        run(7, trace.append)
    assert traces[0] == traces[1]
    assert len(traces[0]) > 10


@pytest.mark.nightly
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("mutant", MUTANTS)
def test_each_fault_of_the_product_is_found(mutant: str) -> None:
    """A fault that no seed finds shows what the world does not see."""
    assert first_broken(mutant, range(1000)) is not None
