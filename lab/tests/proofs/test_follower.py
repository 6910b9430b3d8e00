"""Check the model of a follower of the lease (`lab/proofs/follower.pml`) exhaustively, and its mutants."""

from pathlib import Path

import pytest

from lab.proofs.spin import FollowerBounds, search

ANY_ORDER = FollowerBounds(expiry=3, write=4)
SERVED = FollowerBounds(expiry=5, write=6, served=True)
MUTANTS = {
    "NO_MARGIN": ("fenced", ANY_ORDER),
    "COUNTED_LATE": ("fenced", ANY_ORDER),
    "OVERTAKEN": ("newest", ANY_ORDER),
    "NOT_ABANDONED": ("newest", ANY_ORDER),
    "OLD_LEASE": ("newest", ANY_ORDER),
    "NEVER_SHUTS": ("shut", ANY_ORDER),
    "ONE_THREAD": ("kept", SERVED),
}


@pytest.mark.parametrize("bounds", [ANY_ORDER, SERVED], ids=str)
def test_every_order_keeps_the_promises(tmp_path: Path, bounds: FollowerBounds) -> None:
    found = search(tmp_path, bounds, large=True)
    assert found.broken == ""
    assert found.states > 100_000


@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_wrong_rule_would_be_found(tmp_path: Path, mutant: str) -> None:
    broken, bounds = MUTANTS[mutant]
    assert search(tmp_path, bounds, mutant, large=True).broken == broken
