from pathlib import Path

import pytest
from rosrv_fleet.collector import Collector
from rosrv_fleet.config import BundlesConfig
from rosrv_fleet.enrolment import RobotGroup
from rosrv_fleet.health import RobotState, health_of
from rosrv_fleet.robots import Robots
from rosrv_fleet.rollouts.machine import RobotSeen
from rosrv_fleet.rollouts.service import ConditionKind

from appliance.base.clock import wall
from fleet.tests.support.collectors import collector_in
from fleet.tests.support.enrolled_robots import JoiningAppliance, enrolled_robots
from tests.support.virtual_clock import let_time_pass, set_wall


def state_in(collector: Collector) -> RobotState:
    (state,) = health_of(collector).robots
    return state


def test_a_quiet_robot_is_not_silent(tmp_path: Path) -> None:
    enrolled_robots(tmp_path, "arm7")
    collector = collector_in(tmp_path)
    let_time_pass(599)
    assert not state_in(collector).silent
    let_time_pass(2)
    assert state_in(collector).silent
    collector.presence.heard("arm7", "a")
    let_time_pass(5)
    for one in (collector, collector_in(tmp_path)):
        assert not state_in(one).silent
        assert state_in(one).heard_seconds == pytest.approx({"a": 5})
    let_time_pass(601)
    assert state_in(collector).silent


def test_the_time_of_a_stopped_collector_is_not_silence(tmp_path: Path) -> None:
    enrolled_robots(tmp_path, "arm7")
    let_time_pass(86_400)
    collector = collector_in(tmp_path)
    assert not state_in(collector).silent
    let_time_pass(601)
    assert state_in(collector).silent


@pytest.mark.parametrize("years", [-3, 3], ids=["back", "ahead"])
def test_a_set_clock_makes_no_robot_silent_and_hides_none(years: float, tmp_path: Path) -> None:
    enrolled_robots(tmp_path, "arm7")
    collector = collector_in(tmp_path)
    collector.presence.heard("arm7", "a")
    set_wall(wall() + years * 365 * 86_400)
    assert not state_in(collector).silent
    let_time_pass(601)
    assert state_in(collector).silent


def test_a_robot_that_was_switched_off_is_not_silent(tmp_path: Path) -> None:
    enrolled_robots(tmp_path, "arm7")
    collector = collector_in(tmp_path)
    collector.presence.heard("arm7", "a", off=True)
    let_time_pass(86_400)
    for one in (collector, collector_in(tmp_path)):
        assert (state_in(one).silent, state_in(one).off) == (False, True)
    collector.presence.heard("arm7", "a")
    for one in (collector, collector_in(tmp_path)):
        assert not state_in(one).off
    let_time_pass(601)
    assert (state_in(collector).silent, state_in(collector).off) == (True, False)


def test_each_appliance_of_a_pair_is_heard(tmp_path: Path) -> None:
    robots = Robots(tmp_path / "robots")
    JoiningAppliance().join(robots)
    JoiningAppliance().join(robots, "b")
    collector = collector_in(tmp_path)
    let_time_pass(700)
    collector.presence.heard("arm7", "b", off=True)
    state = state_in(collector)
    assert (state.silent, state.off, state.heard_seconds) == (True, False, {"a": None, "b": 0})
    collector.presence.heard("arm7", "a")
    assert (state_in(collector).silent, state_in(collector).off) == (False, True)


def test_a_pair_is_off_in_a_rollout_only_with_both_appliances(tmp_path: Path) -> None:
    """Otherwise a switched off standby would hide that the active appliance is silent."""
    group = RobotGroup("site-a", "arms")
    bundles = BundlesConfig(folder=tmp_path, timestamp_key=tmp_path)
    collector = collector_in(tmp_path, bundles=bundles)
    for appliance in ("a", "b"):
        JoiningAppliance().join(collector.robots, appliance)
    assert collector.bundles is not None
    collector.bundles.robots[group] = {"arm7": RobotSeen(1.0)}
    kinds = []
    for appliance in ("b", "a"):
        collector.presence.heard("arm7", appliance, off=True)
        kinds.append(collector.bundles.conditions(group)["arm7"].kind)
    assert kinds == [ConditionKind.SILENT, ConditionKind.OFF]


def test_a_full_disk_makes_no_robot_silent(tmp_path: Path) -> None:
    enrolled_robots(tmp_path, "arm7")
    (tmp_path / "heard").write_text("a file, so that no folder can be made")
    collector = collector_in(tmp_path)
    let_time_pass(700)
    collector.presence.heard("arm7", "a")
    assert not state_in(collector).silent
