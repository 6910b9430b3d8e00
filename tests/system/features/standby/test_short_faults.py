import pytest

from benchmarks.standby_faults import FAULTS, faults
from tests.support.nodes import has_ros
from tests.support.requirements import need_program, need_root, needs


@pytest.mark.parametrize("kind", FAULTS)
def test_no_short_fault_ends_a_subscription(kind: str) -> None:
    need_root()
    need_program("nft", "nftables")
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
    assert faults(kind, 2) == 0
