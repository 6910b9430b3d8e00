import math
from typing import Any

import numpy as np
import pytest

from appliance.features.guards.message_types import ANY_TYPE, GOAL
from appliance.features.guards.presets import PRESETS, loaded_values
from rosmop.tests.acting import STORE, fields, message
from rosmop.tests.examples import examples
from tests.unit.features.guards.guarding import Guarded, legs_of, seeded, twist

TRACES = range(examples(1000))
GO = twist(0.5)


def runs(guard: Guarded, at: int) -> bool:
    return guard.drive(GO, at)[0] == 0.5


def stops(guard: Guarded) -> list[int]:
    found = [at for at, data in guard.got if legs_of(data)[0] == 0]
    guard.got.clear()
    return found


def button(on: bool) -> bytes:
    return message("std_msgs/Bool", data=on)


@pytest.mark.parametrize("hands", [False, True])
def test_an_emergency_stop_stays_until_a_reset(hands: bool) -> None:
    random = seeded(7)
    for _trace in TRACES:
        guard, at = Guarded("estop", twoHands=hands), 0
        latched = pressed = released = False
        hand, hand_at = "", 0
        for _message in range(30):
            at += random.choice((1, 30, 500, 1999, 2001))
            given = random.choice(("stop", "reset", "reset", "reset", "command", "command"))
            on = random.random() < (0.3 if given == "stop" else 0.5)
            if given == "command":
                assert runs(guard, at) != latched
                continue
            node = random.choice(("/a", "/b"))
            guard.tell(given, button(on), at, node)
            if given == "stop":
                pressed, latched = on, latched or on
                hand = "" if on else hand
            elif not on:
                released = True
            elif released and latched and not pressed:
                released = False
                if not hands or (hand not in {"", node} and at - hand_at <= 2000):
                    latched, hand = False, ""
                else:
                    hand, hand_at = node, at
            else:
                released = False


def test_an_emergency_stop_is_sent_at_once_and_repeated() -> None:
    guard = Guarded("estop")
    assert runs(guard, 1)
    stops(guard)
    guard.tell("stop", button(True), 5)
    guard.advance(200)
    assert stops(guard) == [5, 100, 200]
    guard = Guarded("estop", silent=1)
    assert not runs(guard, 1)
    guard.tell("stop", button(False), 2)
    assert runs(guard, 1002) and not runs(guard, 1003)


def scan(ranges: list[float]) -> bytes:
    return message("sensor_msgs/LaserScan", ranges=ranges)


def test_a_sensor_is_silent_frozen_or_blind() -> None:
    random = seeded(8)
    for _trace in TRACES:
        guard, at, heard = Guarded("sensor", frozen=3, least=0.5), 0, -math.inf
        before: list[float] = []
        repeated, seeing = 0, False
        for _message in range(20):
            at += random.choice((1, 20, 100, 499, 500, 501))
            if random.random() < 0.4:
                assert runs(guard, at) == (seeing and at - heard <= 500 and repeated < 3)
                continue
            ranges = before or [1.0] * 4
            if random.random() < 0.4:
                ranges = [random.choice((1.0, 1.0000001, math.nan, math.inf)) for _ in range(4)]
            if random.random() < 0.05:
                ranges = []
            repeated = repeated + 1 if np.array_equal(ranges, before, equal_nan=True) and heard > 0 else 0
            finite = sum(map(math.isfinite, ranges))
            before, heard, seeing = ranges, at, finite > 0 and finite >= len(ranges) / 2
            guard.tell("by", scan(ranges), at)


@pytest.mark.parametrize("preset", ["sensor", "separation"])
def test_a_scan_that_is_too_large_to_judge_stops_the_base(preset: str) -> None:
    guard = Guarded(preset)
    near = message("sensor_msgs/LaserScan", ranges=[4.0], range_max=30.0)
    guard.tell("by", near, 1)
    assert runs(guard, 2)
    huge = message("sensor_msgs/LaserScan", ranges=np.full(400_000, 4.0, dtype=np.float32), range_max=30.0)
    guard.tell("by", huge, 3, faults=True)
    stops(guard)
    assert not runs(guard, 4)
    guard.tell("by", near, 5)
    assert runs(guard, 6)


ODOM = "nav_msgs/Odometry"
BLIND = {
    "fence": tuple(
        message(ODOM, pose__pose__position__x=x, pose__pose__orientation__w=1.0) for x in (0.0, math.nan)
    ),
    "arm": tuple(message("sensor_msgs/BatteryState", percentage=charge) for charge in (1.0, math.nan)),
    "sensor": tuple(message("sensor_msgs/LaserScan", ranges=[r]) for r in (4.0, math.nan)),
    "separation": tuple(
        message("sensor_msgs/LaserScan", ranges=[r], range_max=30.0) for r in (4.0, math.nan)
    ),
}


@pytest.mark.parametrize("preset", BLIND)
@pytest.mark.parametrize("fault", ["NaN", "cut short"])
def test_a_faulty_sensor_never_releases_the_base(preset: str, fault: str) -> None:
    guard, (good, bad) = Guarded(preset), BLIND[preset]
    guard.tell("by", good, 1)
    assert runs(guard, 2)
    if fault == "NaN":
        guard.tell("by", bad, 3)
        assert not runs(guard, 4)
    else:
        guard.tell("by", good[:20], 3, faults=True)
        assert not runs(guard, 15_000)


def test_many_values_are_compared_by_their_sum() -> None:
    guard = Guarded("sensor", frozen=2)
    for at, (first, moves) in enumerate(((1.0, True), (1.0, True), (1.0, False), (2.0, True)), 1):
        guard.tell("by", scan([first] + [3.0] * 5000), at)
        assert runs(guard, at) == moves


def test_a_moving_base_is_stopped_when_its_sensor_falls_silent() -> None:
    guard = Guarded("sensor")
    guard.tell("by", scan([1.0]), 5)
    assert runs(guard, 10)
    guard.advance(1000)
    assert stops(guard) == [520]


SENSED: dict[str, dict[str, Any]] = {
    "sensor_msgs/Range": {"range": 1.0},
    "sensor_msgs/NavSatFix": {"latitude": 40.0},
    "sensor_msgs/Imu": {"angular_velocity__x": 0.1},
    "nav_msgs/Odometry": {"pose__pose__position__x": 1.0},
    "sensor_msgs/JointState": {"position": [0.5], "name": ["elbow"]},
}


@pytest.mark.parametrize("kind", SENSED)
def test_other_sensors_are_watched_likewise(kind: str) -> None:
    assert set(SENSED) == {*PRESETS["sensor"].topics["by"]} - {
        "sensor_msgs/LaserScan",
        "sensor_msgs/Joy",
        ANY_TYPE,
    }
    guard = Guarded("sensor", {"by": kind}, frozen=2)
    for at, moves in ((1, True), (2, True), (3, False)):
        guard.tell("by", message(kind, **SENSED[kind]), at)
        assert runs(guard, at) == moves
    name, value = next(iter(SENSED[kind].items()))
    guard.tell("by", message(kind, **{name: [math.nan] if isinstance(value, list) else math.nan}), 4)
    assert not runs(guard, 4) or kind in {"sensor_msgs/NavSatFix", "sensor_msgs/Imu", "nav_msgs/Odometry"}


@pytest.mark.parametrize("kind", ["sensor_msgs/Joy", "std_msgs/Header"])
def test_only_the_silence_of_any_other_type_is_judged(kind: str) -> None:
    """A joystick at rest repeats its values; a broken link is silent."""
    guard = Guarded("sensor", {"by": kind}, frozen=2)
    for at in range(0, 1000, 100):
        guard.tell("by", message(kind), at)
        assert runs(guard, at + 1)
    guard.advance(3000)
    assert stops(guard) == [1420]


def speed(v: float) -> bytes:
    return message("nav_msgs/Odometry", twist__twist__linear__x=v)


def test_two_sources_agree_for_a_number_of_messages() -> None:
    random = seeded(9)
    for _trace in TRACES:
        guard, at, others, other_at, mine_at = Guarded("agree", samples=3), 0, math.nan, -math.inf, -math.inf
        row, good = 0, False
        for _message in range(25):
            at += random.choice((1, 50, 50, 501))
            given = random.choice(("by", "by", "other", "command"))
            v = random.choice((0.0, 0.1, 0.1, 0.30001, math.nan))
            if given == "command":
                assert runs(guard, at) == (good and at - mine_at <= 500 and at - other_at <= 500)
                continue
            guard.tell(given, speed(v), at)
            if given == "other":
                others, other_at = v, at
                continue
            mine_at = at
            agrees = abs(v - others) <= 0.1 and at - other_at <= 500
            row = (max(row, 0) + 1) if agrees else (min(row, 0) - 1)
            good = (good or row >= 3) and row > -3


@pytest.mark.parametrize(
    ("charge", "fixed", "checked", "passes"),
    [(0.5, 0, True, True), (0.25, 0, True, True), (0.2499, 0, True, False), (math.nan, 0, True, False),
     (0.5, -1, True, False), (0.5, 0, False, False), (None, 0, True, False), (0.5, None, True, False),
     (0.5, 0, None, False)],
)  # fmt: skip
def test_an_interlock_needs_battery_position_and_check(
    charge: float | None, fixed: int | None, checked: bool | None, passes: bool
) -> None:
    guard = Guarded("arm", charge=0.25, needFix=True, needCheck=True, silent=1)
    if charge is not None:
        guard.tell("by", message("sensor_msgs/BatteryState", percentage=charge), 1)
    if fixed is not None:
        guard.tell("fix", message("sensor_msgs/NavSatFix", status__status=fixed), 1)
    if checked is not None:
        guard.tell("check", button(checked), 1)
    assert runs(guard, 2) == passes
    assert not runs(guard, 1002)
    guard.tell("by", message("sensor_msgs/BatteryState", percentage=1.0), 1003)
    assert not runs(guard, 1003)


def trajectory(names: list[str], *points: tuple[float, list[float]]) -> bytes:
    point = STORE.types["trajectory_msgs/msg/JointTrajectoryPoint"]
    duration = STORE.types["builtin_interfaces/msg/Duration"]
    empty = np.array([], dtype=np.float64)
    made = [
        point(
            positions=np.array(positions, dtype=np.float64),
            velocities=empty,
            accelerations=empty,
            effort=empty,
            time_from_start=duration(sec=int(at), nanosec=round(at % 1 * 1e9)),
        )
        for at, positions in points
    ]
    return message("trajectory_msgs/JointTrajectory", joint_names=names, points=made)


JOINTS = ["elbow", "wrist"]


@pytest.mark.parametrize(
    ("points", "passes"),
    [
        ([], True),
        ([(1, [0, 0]), (2, [1, 1])], True),
        ([(1, [1.5, 2.0]), (2, [-1.5, 0])], True),
        ([(1, [1.51, 0])], False),
        ([(1, [math.nan, 0])], False),
        ([(1, [0])], False),
        ([(1, [0, 0]), (1, [0, 0])], False),
        ([(2, [0, 0]), (1, [0, 0])], False),
        ([(1, [0, 0]), (1.1, [1, 0])], False),
    ],
)
def test_a_trajectory_keeps_the_limits_of_its_joints(points: Any, passes: bool) -> None:
    guard = Guarded("joints", limits="elbow:-1.5..1.5 wrist:-2..2")
    for names, good in ((JOINTS, passes), (["elbow", "unknown"], passes and not points)):
        outcome = guard.tell("command", trajectory(names, *points), 1)
        assert (outcome.result == "passed") == good
        assert good or not fields("trajectory_msgs/JointTrajectory", bytes(outcome.buffer)).points


def with_id(name: str, before: int, behind: int) -> bytes:
    return bytes(before) + len(name).to_bytes(4, "little") + name.encode() + bytes(behind)


def test_a_goal_without_a_result_is_cancelled() -> None:
    guard = Guarded("answer", limit="2s")
    goals = [
        guard.tell("command", with_id(name, 24, 72), at) for name, at in (("a", 1), ("b", 500), ("", 600))
    ]
    assert [one.result for one in goals] == ["passed", "passed", "dropped"]
    guard.tell("by", with_id("b", 24, 5), 900)
    guard.got.clear()
    guard.advance(10_000)
    assert [(at, fields("actionlib_msgs/GoalID", data).id) for at, data in guard.got] == [(2001, "a")]


def test_a_topic_is_withheld_until_the_switch_is_off_and_speaks() -> None:
    types, hosts = {"command": "std_msgs/String", "by": "std_msgs/Bool"}, ("10.0.0.7/32", "10.8.0.0/16")
    guard = Guarded("withhold", types, hosts="10.0.0.7 10.8.0.0/16", silent=1)
    assert guard.monitors.withheld_from("/camera/image_raw") == hosts
    for at, on, withheld in ((1, False, ()), (900, True, hosts), (1000, False, ())):
        guard.tell("by", button(on), at)
        assert guard.monitors.withheld_from("/camera/image_raw") == withheld
    guard.advance(2100)
    assert guard.monitors.withheld_from("/camera/image_raw") == hosts
    assert loaded_values(guard.text) == {"hosts": " ".join(hosts)}


def test_for_an_action_a_stop_drops_goals_and_cancels_all() -> None:
    """An empty goal would not stop an arm."""
    guard = Guarded("estop", {"command": GOAL})
    assert guard.tell("command", with_id("a", 24, 40), 1).result == "passed"
    guard.got.clear()
    guard.tell("stop", button(True), 2)
    [(at, cancel)] = guard.got
    assert (at, fields("actionlib_msgs/GoalID", cancel).id) == (2, "")
    assert guard.tell("command", with_id("b", 24, 40), 3).result == "dropped"
