"""Each preset in a deployed appliance with its real budget, and the largest messages of real robots."""

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from appliance.features.guards.presets import PRESETS, Preset
from appliance.features.guards.released import FOLDER as RELEASED
from appliance.features.guards.released import released_preset
from benchmarks.published_stop import busy_programs
from examples.landshark.lab import Host
from tests.support.appliance import Appliance
from tests.support.features.guards.guarded_robot import ACTS, RAYS, Act, GuardedRobot, Row, rows
from tests.support.nodes import RosSession

ROWS = rows()
FEW = [act for act in ACTS if act.name in {"load", "malformed", "silence"}]
SCANNED = [row for row in ROWS if any(one.kind == "sensor_msgs/LaserScan" for one in row.streams.values())]
OLDER = [
    (row, preset)
    for row in ROWS
    for path in sorted(RELEASED.glob(f"{row.preset}-*.rv"))
    if (preset := released_preset(row.preset, int(path.stem.rpartition("-")[2]))).version
    < PRESETS[row.preset].version
]


@pytest.fixture
def ros(own_appliance: Appliance, common_robot: Host, tmp_path: Path) -> RosSession:
    return RosSession(own_appliance.master_uri, tmp_path, common_robot)


def survive(
    appliance: Appliance, ros: RosSession, guards: Sequence[tuple[Row, str]], acts: Sequence[Act]
) -> None:
    with GuardedRobot(appliance, ros, guards) as robot:
        assert robot.moves(0) < math.inf, f"the base never moves: {robot.faults()}"
        robot.lost()  # before the nodes were connected
        assert robot.moves(time.monotonic()) < math.inf
        passages = [robot.after(act) for act in acts]
        assert robot.judged()
    assert all(passage.holds for passage in passages), "\n".join(["", *map(str, passages)])


@pytest.mark.parametrize("row", ROWS, ids=[row.name for row in ROWS])
def test_a_robot_moves_again_after_each_act(own_appliance: Appliance, ros: RosSession, row: Row) -> None:
    """The base moves within a second, nothing faults, and others lose no message, beside two busy loops."""
    with busy_programs(2):
        survive(own_appliance, ros, [(row, row.guard())], ACTS)


@pytest.mark.parametrize("rays", RAYS[:-1])
@pytest.mark.parametrize("preset", [row.preset for row in SCANNED])
def test_a_robot_moves_with_each_scanner(
    own_appliance: Appliance, ros: RosSession, preset: str, rays: int
) -> None:
    row = next(row for row in rows(rays) if row.name in {one.name for one in SCANNED if one.preset == preset})
    with busy_programs(2):
        survive(own_appliance, ros, [(row, row.guard())], FEW)


@pytest.mark.parametrize(
    ("row", "preset"), OLDER, ids=[f"{row.name}-{preset.version}" for row, preset in OLDER]
)
def test_a_robot_moves_behind_the_guards_of_earlier_releases(
    own_appliance: Appliance, ros: RosSession, row: Row, preset: Preset
) -> None:
    """An upgrade of the appliance leaves their texts in force."""
    with busy_programs(2):
        survive(own_appliance, ros, [(row, row.guard(preset))], FEW)


@pytest.mark.real
def test_a_large_scanner_stops_no_robot(own_appliance: Appliance, ros: RosSession) -> None:
    """`separation` and `zone` together judge 1,650 rays from the first scan on, and navigation gets each scan."""
    guards = [(row, row.guard()) for row in SCANNED if row.preset in {"separation", "zone"}]
    acts = [replace(act, within=math.inf) for act in FEW if act.name == "malformed"]
    survive(own_appliance, ros, guards, acts)


def test_a_guard_hears_a_button_that_had_latched_before(own_appliance: Appliance, ros: RosSession) -> None:
    command = ("rostopic", "echo", "-n", "1", "/cmd_vel/linear/x")
    with ros:
        for topic in ("/emergency_stop", "/emergency_stop_reset"):
            ros.start(["rostopic", "pub", "--latch", topic, "std_msgs/Bool", "data: false"])
            ros.run("rostopic", "echo", "-n", "1", topic)
        ros.start(["rostopic", "echo", "/emergency_stop"])  # a display, which keeps the relay's connection
        ros.start(["rostopic", "pub", "--rate", "20", "/cmd_vel", "geometry_msgs/Twist", "linear: {x: 0.2}"])
        assert ros.run(*command).stdout.startswith("0.2")
        own_appliance.rosrv("guard", "new", "estop", "/cmd_vel", "silent=0", "zeroFirst=false")
        assert ros.run(*command).stdout.startswith("0.2")
        own_appliance.rosrv("monitor", "remove", "estop")
