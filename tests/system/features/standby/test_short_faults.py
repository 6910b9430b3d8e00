import pytest

from benchmarks.standby_faults import FAULTS, faults
from tests.support.nodes import need_ros
from tests.support.requirements import need_program, need_root


@pytest.mark.parametrize("kind", FAULTS)
def test_no_short_fault_ends_a_subscription(kind: str) -> None:
    need_root()
    need_program("nft", "nftables")
    need_ros()
    assert faults(kind, 2) == 0
