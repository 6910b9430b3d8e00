from pathlib import Path

import pytest

from lab.proofs.spin import Bounds, search

BOUNDS = [
    Bounds(loads=1, policies=1, crashes=1),
    Bounds(loads=2, crashes=1),
    Bounds(loads=2, policies=1),
    Bounds(loads=1, policies=1, crashes=1, sending=False),
    Bounds(subscribers=2, loads=1),
    Bounds(subscribers=2, policies=1),
    Bounds(subscribers=2, crashes=1),
    Bounds(publishers=2, policies=1),
    Bounds(publishers=2, crashes=1),
]


@pytest.mark.parametrize("bounds", BOUNDS, ids=str)
def test_every_order_keeps_the_promises(tmp_path: Path, bounds: Bounds) -> None:
    found = search(tmp_path, bounds, large=True)
    assert found.broken == ""
    assert found.states > 50_000
