from pathlib import Path

import pytest

from lab.proofs.spin import LeaseBounds, search

BOUNDS = [LeaseBounds(grants=2, last_fault=True)]


@pytest.mark.parametrize("bounds", BOUNDS, ids=str)
def test_every_order_keeps_the_promises(tmp_path: Path, bounds: LeaseBounds) -> None:
    found = search(tmp_path, bounds, large=True)
    assert found.broken == ""
    assert found.states > 1_000_000
