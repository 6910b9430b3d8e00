"""Check the model of the insertion (`lab/proofs/insertion.pml`) exhaustively.

Larger bounds are in `test_insertion_at_large.py`, wrong programs in `test_insertion_mutants.py`.
"""

from pathlib import Path

import pytest

from lab.proofs.spin import Bounds, search

BOUNDS = [
    Bounds(loads=2),
    Bounds(policies=2, crashes=1),
    Bounds(loads=1, crashes=1, refusing=True),
    Bounds(publishers=2, crashes=1, sending=False),
]


@pytest.mark.parametrize("bounds", BOUNDS, ids=str)
def test_every_order_keeps_the_promises(tmp_path: Path, bounds: Bounds) -> None:
    found = search(tmp_path, bounds)
    assert found.broken == ""
    assert found.states > 1000
