import pytest

from appliance.features.fleet.bundle_gate import disabled_among
from appliance.specifications.specification_files import CheckedSpecifications
from appliance.specifications.switches import Switches


@pytest.mark.parametrize(
    ("enable", "end"),
    [
        ("all", ""),
        ("shadow", ""),
        ("zone", "; disabled on this robot: fence (rosrv monitor enable)"),
        ("none", "; disabled on this robot: fence, zone (rosrv monitor enable)"),
    ],
)
def test_the_record_of_a_bundle_names_the_monitors_that_do_nothing(enable: str, end: str) -> None:
    checked = CheckedSpecifications(monitors={"fence": "fence.rv", "zone": "zone.rv"})
    assert disabled_among(Switches(enable).of(checked).states) == end
