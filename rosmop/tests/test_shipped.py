import gc
import math
from collections.abc import Callable
from pathlib import Path

import pytest

from rosmop.check.sources import compiled_from
from rosmop.form.compiled import Compiled
from rosmop.run.engine import MonitorSet
from rosmop.run.interpreter import Interpreter
from rosmop.run.monitor import MonitorInstance
from rosmop.run.outcomes import Outcome
from rosmop.tests.acting import fields, message
from rosmop.tests.on_module import on_module
from roswire.definitions import Definitions
from roswire.standard import standard_definitions

ROOT = Path(__file__).parents[2]
MONITORS = ROOT / "monitors"
SECOND = 10**9


def shipped(*names: str, made: Callable[[Compiled], MonitorSet] = MonitorSet.of) -> MonitorSet:
    trigger = MONITORS / "msg" / "landshark_msgs" / "PaintballTrigger.msg"
    own = Definitions.from_files({"landshark_msgs/PaintballTrigger.msg": trigger.read_text()})
    sources = {f"{name}.rv": (MONITORS / f"{name}.rv").read_text() for name in names}
    monitors = made(compiled_from(sources, standard_definitions().merge(own)))
    started = monitors.start(0)
    assert not started.faults
    return monitors


TRIGGER = message("std_msgs/Header", frame_id="ocu") + b"\x01"


def joints(tilt: float) -> bytes:
    return message("sensor_msgs/JointState", name=["turret_pan", "turret_tilt"], position=[0.1, tilt])


def drive(forward: float) -> bytes:
    return message("geometry_msgs/TwistStamped", twist__linear__x=forward, twist__angular__z=0.5)


def test_they_load_together_without_a_warning() -> None:
    monitors = shipped(*sorted(path.stem for path in MONITORS.glob("*.rv")))
    assert monitors.warnings == ()
    assert [monitor.name for monitor in monitors.monitors] == [
        "goals", "logging", "obstacleAvoidance", "safeTrigger", "safeZone",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("tilt", "result"),
    [(None, "dropped"), (0.2, "passed"), (-0.5, "dropped"), (-0.45, "dropped"), (-0.44, "passed")],
)
def test_the_gun_fires_only_in_a_safe_pose(tilt: float | None, result: str) -> None:
    """Figure 4.4: the trigger is dropped unless the gun was last seen above -0.45."""
    monitors = shipped("safe_triggering")
    if tilt is not None:
        assert monitors.process("/landshark/joint_states", joints(tilt), 1).result == "passed"
    assert monitors.process("/landshark_control/trigger", TRIGGER, 2).result == result


def test_the_gun_is_watched_all_the_time() -> None:
    monitors = shipped("safe_triggering")
    seen = []
    for time, tilt in enumerate((0.2, -0.7, 0.1)):
        monitors.process("/landshark/joint_states", joints(tilt), time)
        seen.append(monitors.process("/landshark_control/trigger", TRIGGER, time).result)
    assert seen == ["passed", "dropped", "passed"]


def odometry(x: float, y: float = 0.0, speed: float = 0.0) -> bytes:
    return message("nav_msgs/Odometry", pose__pose__position__x=x, pose__pose__position__y=y,
                   twist__twist__linear__x=speed, child_frame_id="base_link")  # fmt: skip


def fix(latitude: float, longitude: float) -> bytes:
    return message("sensor_msgs/NavSatFix", latitude=latitude, longitude=longitude)


@pytest.mark.parametrize(
    ("topic", "inside", "outside"),
    [
        ("/landshark/odom", odometry(5.0), odometry(15.0, 14.0)),
        ("/landshark/gps", fix(37.4567, -122.1733), fix(37.4567 + 25 / 111194.9, -122.1733)),
        ("/landshark/gps", fix(37.4567, -122.1732), fix(37.4567, -122.1733 + 0.001)),
        ("/landshark/gps", fix(37.4567, -122.1733), fix(math.nan, -122.1733)),
    ],
)
def test_the_robot_stays_in_its_zone(topic: str, inside: bytes, outside: bytes) -> None:
    monitors = shipped("safe_zone")
    command = "/landshark_control/base_velocity"
    monitors.process(topic, inside, 1)
    assert monitors.process(command, drive(1.0), 2).result == "passed"
    monitors.process(topic, outside, 3)
    stopped = monitors.process(command, drive(1.0), 4)
    assert (stopped.result, stopped.log[0].level) == ("dropped", "WARN")
    assert monitors.process(command, drive(math.nan), 5).result == "dropped"
    assert monitors.process(command, drive(-1.0), 6).result == "passed"
    monitors.process(topic, inside, 7)
    assert monitors.process(command, drive(1.0), 8).result == "passed"


def scan(distance: float, beams: int = 61) -> bytes:
    ranges = [math.inf] * beams
    ranges[beams // 2] = distance
    step = math.radians(120) / (beams - 1)
    return message("sensor_msgs/LaserScan", angle_min=-math.radians(60), angle_increment=step, ranges=ranges)


def commanded(monitors: MonitorSet, time: int, forward: float = 1.0) -> Outcome:
    return monitors.process("/landshark_control/base_velocity", drive(forward), time)


def test_the_robot_stops_before_an_obstacle() -> None:
    monitors = shipped("obstacle_avoidance")
    monitors.process("/landshark/odom", odometry(0, speed=1.0), 1)
    monitors.process("/landshark/scan", scan(5.0), 2)
    assert commanded(monitors, 3).result == "passed"
    monitors.process("/landshark/scan", scan(1.0), 4)
    stopped = commanded(monitors, 5)
    twist = fields("geometry_msgs/TwistStamped", bytes(stopped.buffer)).twist
    assert (stopped.result, twist.linear.x, twist.angular.z) == ("changed", 0.0, 0.5)
    [alarm] = stopped.published
    assert (alarm.topic, alarm.type) == ("/landshark/obstacle_alarm", "std_msgs/String")
    assert fields("std_msgs/String", alarm.data).data.startswith(
        "obstacle at 1.000000 m, 1.233333 m must be free"
    )
    monitors.process("/landshark/odom", odometry(0, speed=0.2), 6)
    assert commanded(monitors, 7).result == "passed"


def test_an_obstacle_beside_the_robot_does_not_stop_it() -> None:
    monitors = shipped("obstacle_avoidance")
    ranges = [0.2] * 5 + [9.0] * 51 + [0.2] * 5
    step = math.radians(120) / 60
    monitors.process("/landshark/scan", message(
        "sensor_msgs/LaserScan", angle_min=-math.radians(60), angle_increment=step, ranges=ranges), 2)  # fmt: skip
    assert commanded(monitors, 3).result == "passed"


def test_a_silent_laser_stops_the_robot() -> None:
    monitors = shipped("obstacle_avoidance")
    assert commanded(monitors, 1).result == "changed"
    monitors.process("/landshark/scan", scan(9.0), SECOND)
    assert commanded(monitors, SECOND + 300_000_000).result == "passed"
    assert commanded(monitors, 2 * SECOND).result == "changed"
    monitors.process("/landshark/scan", scan(9.0), 2 * SECOND + 50_000_000)
    assert commanded(monitors, 2 * SECOND + 150_000_000).result == "passed"


def test_logging_changes_nothing() -> None:
    monitors = shipped("logging")
    lines = []
    for time, charge in enumerate((1.0, 0.98, 0.94, 0.2)):
        data = message("sensor_msgs/BatteryState", percentage=charge, voltage=24.0)
        outcome = monitors.process("/landshark/battery", data, time)
        assert outcome.result == "passed"
        lines += [(line.level, line.text) for line in outcome.log]
    assert lines == [
        ("INFO", "battery at 100%, 24.0 V"),
        ("INFO", "battery at 94%, 24.0 V"),
        ("INFO", "battery at 20%, 24.0 V"),
        ("WARN", "battery below a quarter: 20%"),
    ]
    turret = monitors.process("/landshark_control/turret", joints(0.25), 9)
    assert [line.text for line in turret.log] == ["turret_pan to 0.10 rad", "turret_tilt to 0.25 rad"]
    shot = monitors.process("/landshark_control/trigger", TRIGGER, 10)
    assert (shot.result, shot.log[0].text) == ("passed", "trigger 1")


def goal(monitors: MonitorSet, part: str, name: str, time: float) -> Outcome:
    types = {
        "goal": "actionlib/TestActionGoal",
        "result": "actionlib/TestActionResult",
        "cancel": "actionlib_msgs/GoalID",
    }
    path = {"goal": "goal_id__id", "result": "status__goal_id__id", "cancel": "id"}[part]
    data = message(types[part], **{path: name})
    return monitors.process(f"/count/{part}", data, int(time * SECOND))


def test_each_goal_is_answered_within_its_cancel() -> None:
    monitors = shipped("goals")
    for number, name in enumerate(("a", "b", "c")):
        goal(monitors, "goal", name, number)
    goal(monitors, "cancel", "a", 3)
    goal(monitors, "cancel", "b", 3.2)
    goal(monitors, "result", "a", 5)
    said = [(each.time / SECOND, line.text) for each in monitors.advance(20 * SECOND) for line in each.log]
    assert said == [(6.2, "goal b is not answered 3.0 s after it was cancelled")]


def test_an_id_is_that_of_one_goal() -> None:
    monitors = shipped("goals")
    goal(monitors, "goal", "a", 1)
    (verdict,) = goal(monitors, "goal", "a", 2).verdicts
    assert (verdict.category, verdict.binding) == ("twice", {"id": "a"})
    goal(monitors, "result", "a", 3)
    slices = monitors.monitors[0].slices
    assert slices is not None
    assert slices.live == 0


def test_a_set_that_is_gone_leaves_nothing_to_the_garbage_collector() -> None:
    """Otherwise the collector would delay all messages: by a tenth of a second after some loads of fifty."""
    monitors = shipped(*(path.stem for path in MONITORS.glob("*.rv")), made=on_module)
    monitors.process("/landshark_control/base_velocity", drive(1.0), SECOND)
    assert monitors.process("/landshark_control/base_velocity", b"", SECOND).faults
    known = {id(part) for part in (*monitors.monitors, monitors.interpreter)}
    gc.disable()
    try:
        del monitors
        left = [
            part
            for part in gc.get_objects()
            if id(part) in known and isinstance(part, (MonitorInstance, Interpreter))
        ]
    finally:
        gc.enable()
    assert not left
