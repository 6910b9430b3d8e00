from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from rosrv_fleet.collector import Collector
from rosrv_fleet.health import RobotState, health_of
from rosrv_fleet.presence import RobotPresence
from rosrv_fleet.robots import Robots
from rosrv_fleet.segment_store import SegmentStore

from tests.support.enrolled_robots import JoiningAppliance, enrolled_robots
from tests.support.virtual_clock import let_time_pass


def state_of(data: Path, presence: RobotPresence) -> RobotState:
    up = SimpleNamespace(trouble=None)
    parts = SimpleNamespace(
        store=SegmentStore(data, 0), robots=Robots(data / "robots"), presence=presence, indexer=up, pruner=up,
        config=SimpleNamespace(silent_seconds=600.0),
    )  # fmt: skip
    (state,) = health_of(cast(Collector, parts)).robots
    return state


def test_a_quiet_robot_is_not_silent(tmp_path: Path) -> None:
    enrolled_robots(tmp_path, "arm7")
    presence = RobotPresence(tmp_path / "heard")
    let_time_pass(599)
    assert not state_of(tmp_path, presence).silent
    let_time_pass(2)
    assert state_of(tmp_path, presence).silent
    presence.heard("arm7", "a")
    let_time_pass(5)
    for one in (presence, RobotPresence(tmp_path / "heard")):
        state = state_of(tmp_path, one)
        assert not state.silent
        assert state.heard_seconds == pytest.approx({"a": 5})
    let_time_pass(601)
    assert state_of(tmp_path, presence).silent


def test_the_time_of_a_stopped_collector_is_not_silence(tmp_path: Path) -> None:
    enrolled_robots(tmp_path, "arm7")
    let_time_pass(86_400)
    presence = RobotPresence(tmp_path / "heard")
    assert not state_of(tmp_path, presence).silent
    let_time_pass(601)
    assert state_of(tmp_path, presence).silent


def test_each_appliance_of_a_pair_is_heard(tmp_path: Path) -> None:
    robots = Robots(tmp_path / "robots")
    JoiningAppliance().join(robots)
    JoiningAppliance().join(robots, "b")
    presence = RobotPresence(tmp_path / "heard")
    let_time_pass(700)
    presence.heard("arm7", "b")
    state = state_of(tmp_path, presence)
    assert (state.silent, state.heard_seconds) == (True, {"a": None, "b": 0})
    presence.heard("arm7", "a")
    assert not state_of(tmp_path, presence).silent


def test_a_full_disk_makes_no_robot_silent(tmp_path: Path) -> None:
    enrolled_robots(tmp_path, "arm7")
    (tmp_path / "heard").write_text("a file, so that no folder can be made")
    presence = RobotPresence(tmp_path / "heard")
    let_time_pass(700)
    presence.heard("arm7", "a")
    assert not state_of(tmp_path, presence).silent
