import json
from pathlib import Path

from examples.landshark.lab import Lab
from tests.support.features.standby.standby_site import StandbySite
from tests.support.own_namespace import own_namespace
from tests.support.requirements import need_program, need_root
from tests.support.waiting import eventually


def test_a_graph_that_was_adopted_before_the_pair_is_an_alarm(tmp_path: Path) -> None:
    """The robot's nodes use their own master, which the appliance no longer guards."""
    need_root()
    need_program("nft", "nftables")
    with (
        own_namespace(),
        Lab("rosrv-adopted") as lab,
        StandbySite(lab, tmp_path, isolation="netns") as site,
    ):
        one = site.appliances["a"]
        record = {"wanted": True, "user": "root", "program": "rosmaster"}  # as `rosrv adopt` writes it
        (one.state / "adopt.json").write_text(json.dumps(record))
        site.start_witness()
        site.start("a")
        site.until_active("a")
        eventually(lambda: "the robot's graph is not adopted" in str(one.rows("alarm", "list")), one.story)
        assert "rosrv release --dead" in one.rosrv("status", check=False).stdout
