from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.channel import admin
from examples.landshark.lab import Lab
from tests.support.appliance import OPEN_POLICY
from tests.support.features.standby.standby_robot import StandbyRobot
from tests.support.features.standby.standby_site import StandbySite
from tests.support.nodes import need_ros
from tests.support.requirements import need_program, need_root

RULE = "seen() { event said() /map std_msgs/String '{}' { } }\n"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StandbySite]:
    need_root()
    need_program("nft", "nftables")
    need_ros()
    home: Path = tmp_path_factory.mktemp("standby")
    with Lab("rosrv-standby") as lab, StandbySite(lab, home, monitors={}) as site:
        site.start_witness()
        site.start("a")
        site.until_active("a")
        one = site.appliances["a"]
        assert one.process is not None
        one.token = one.process.wait_for(event="ready")["token"]
        one.ask(admin.PolicyLoad(OPEN_POLICY + "[Options]\ntakeover = granted\n"))
        one.ask(admin.MonitorLoad({"seen.rv": RULE}))
        one.ask(admin.TokenAdd("colleague", "viewer", 3600.0))
        site.start("b")
        site.until_both_in_sync()
        yield site


@pytest.fixture(scope="module")
def robot(site: StandbySite) -> Iterator[StandbyRobot]:
    with StandbyRobot(site) as robot:
        yield robot
