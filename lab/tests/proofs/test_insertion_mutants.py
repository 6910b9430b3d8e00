from pathlib import Path

import pytest

from lab.proofs.spin import Bounds, search

ONE_OF_EACH = Bounds(loads=1, policies=1, crashes=1)
MUTANTS = {
    "STATED_LATER": ("judged", ONE_OF_EACH),
    "NOT_AWAITED": ("judged", ONE_OF_EACH),
    "ANSWERED_BEFORE_TAKEN": ("judged", ONE_OF_EACH),
    "ANY_ANSWER": ("judged", Bounds(loads=2)),
    "SWAP_IN_TWO": ("judged", ONE_OF_EACH),
    "STALE_LANE": ("judged", ONE_OF_EACH),
    "DECIDED_ONCE": ("judged", ONE_OF_EACH),
    "SWAP_RECONNECTS": ("whole", ONE_OF_EACH),
    "GIVEN_AGAIN": ("whole", ONE_OF_EACH),
    "ANSWERED_BEFORE_CUT": ("barred", ONE_OF_EACH),
    "REVOKED_NOT_CUT": ("barred", ONE_OF_EACH),
    "NOT_REDECIDED": ("barred", ONE_OF_EACH),
    "NOBODY_REMINDED": ("connected", Bounds(crashes=1, sending=False)),
}


@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_wrong_program_would_be_found(tmp_path: Path, mutant: str) -> None:
    broken, bounds = MUTANTS[mutant]
    assert search(tmp_path, bounds, mutant).broken == broken
