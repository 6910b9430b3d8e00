from collections.abc import Iterator

import pytest

from examples.landshark.lab import Lab
from examples.landshark.stage import MASTER_URI, Actor, Stage
from tests.support.nodes import ROOT, need_ros
from tests.support.requirements import need_root
from tests.support.rosmaster import PlainMaster

ATTACKS = [  # attacks that end a node come after attacks that need it
    "watch the battery",
    "look around",
    "spy on the position",
    "forge the trigger",
    "take over the operator",
    "replace a driver",
    "kill a node",
    "go past the master",
    "stop the clock",
    "wipe the parameters",
    "stop the master",
]


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    need_root()
    need_ros()
    home = tmp_path_factory.mktemp("master")
    with (
        Lab("rosrv-test") as lab,
        Stage(lab, ROOT) as stage,
        PlainMaster(home, stage.appliance_host) as master,
    ):
        assert master.master_uri == MASTER_URI
        yield stage


@pytest.fixture(scope="module")
def operator(stage: Stage) -> Actor:
    stage.start_robot()
    operator = stage.start_operator()
    operator.expect("connected")
    return operator


def test_mission(operator: Actor) -> None:
    assert operator.expect("drove")["metres"] >= 3
    assert operator.expect("aimed")["tilt"] == pytest.approx(0.2, abs=0.02)
    assert operator.expect("fired")["shots"] == 1
    position = operator.expect("position")
    assert position["x"] > 3
    assert position["longitude"] > -122.1733


@pytest.mark.parametrize("name", ATTACKS)
def test_attack_succeeds_against_a_plain_master(stage: Stage, operator: Actor, name: str) -> None:
    assert stage.attack(name).succeeded
