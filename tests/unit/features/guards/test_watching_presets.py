import itertools
import math
from typing import Any

import numpy as np
import pytest

from appliance.features.guards.presets import PRESETS, Guard, loaded_values, text_of
from appliance.features.guards.robot_graph import GOAL
from rosmop.tests.acting import STORE, fields, message
from tests.unit.features.guards.guarding import BEGIN, NODES, Guarded, legs_of, twist

GO = twist(0.5)


def runs(guard: Guarded, at: int) -> bool:
    return guard.drive(GO, at)[0] == 0.5


def stops(guard: Guarded) -> list[int]:
    found = [at for at, data in guard.got if legs_of(data)[0] == 0]
    guard.got.clear()
    return found


def button(on: bool) -> bytes:
    return message("std_msgs/Bool", data=on)


def reset(guard: Guarded, at: int, node: str = "/a") -> None:
    for on, when in ((False, at), (True, at + 100)):
        guard.tell("stop", button(False), when)
        guard.tell("reset", button(on), when, node)


def test_a_ninth_button_stops() -> None:
    guard = Guarded("estop", silent=0)
    for place in range(8):
        guard.tell("stop", button(False), 1, NODES[place + 1])
    guard.drive(twist(), 2)
    assert runs(guard, 3)
    guard.tell("stop", button(False), 4, NODES[9])
    assert not runs(guard, 5)


def test_a_ninth_hand_resets_nothing_until_all_are_forgotten() -> None:
    """A tool with a new name for each person uses up the places."""
    guard, at = Guarded("estop", silent=0), 0
    guard.tell("stop", button(False), at)
    for place, node in enumerate((*NODES[2:11], *NODES[10:11]), 1):
        if place == 10:
            guard.monitors.give({"guard": {"forget": 1, "silent": 0}})
        guard.tell("stop", button(True), at + 500)
        reset(guard, at + 600, node)
        guard.drive(twist(), at + 800)
        assert runs(guard, at + 810) == (place != 9)
        at += 1000


@pytest.mark.parametrize("silent", [0, 1])
def test_a_command_may_be_the_first_after_the_buttons_are_forgotten(silent: int) -> None:
    guard = Guarded("estop", silent=silent)
    guard.tell("stop", button(True), 0)
    guard.drive(twist(), 2500)
    guard.monitors.give({"guard": {"forget": 1, "silent": silent}})
    guard.drive(twist(), 2510)
    assert not guard.monitors.monitor("guard").held
    assert not runs(guard, 2520)


def scan(ranges: list[float]) -> bytes:
    return message("sensor_msgs/LaserScan", ranges=ranges, range_min=0.1, range_max=5.0)


FREE = {"ranges": [9.0] * 72, "range_max": 30.0, "angle_min": -math.pi, "angle_increment": math.pi / 36}


@pytest.mark.parametrize("preset", ["sensor", "separation"])
def test_a_scan_that_is_too_large_to_judge_stops_the_base(preset: str) -> None:
    guard = Guarded(preset)
    near = message("sensor_msgs/LaserScan", **FREE)
    guard.tell("by", near, 1)
    assert runs(guard, 2)
    huge = message("sensor_msgs/LaserScan", ranges=np.full(400_000, 4.0, dtype=np.float32), range_max=30.0)
    guard.tell("by", huge, 3, faults=True)
    stops(guard)
    assert not runs(guard, 4)
    guard.tell("by", near, 5)
    assert runs(guard, 6)


ODOM = "nav_msgs/Odometry"


def test_many_values_are_compared_by_their_sum() -> None:
    guard = Guarded("sensor", frozen=2)
    for at, (first, moves) in enumerate(((1.0, True), (1.0, True), (1.0, False), (2.0, True)), 1):
        guard.tell("by", scan([first] + [3.0] * 5000), at)
        assert runs(guard, at) == moves


HONEST: dict[str, list[dict[str, Any]]] = {
    "sensor_msgs/LaserScan": [
        {"range_min": 0.1, "range_max": 10.0, "ranges": [5.0] * seen + [math.inf] * 351} for seen in (0, 9)
    ],
    "sensor_msgs/Range": [
        {"min_range": low, "max_range": 0.8, "range": value}
        for low in (0.02, 0.8) for value in (0.8, math.inf, -math.inf)
    ],
    "sensor_msgs/NavSatFix": [{"latitude": 48.1, "longitude": 11.5, "altitude": math.nan}],
    "sensor_msgs/Imu": [{"linear_acceleration__z": 9.81}],
    "nav_msgs/Odometry": [{"pose__pose__position__x": 3.25, "pose__pose__orientation__w": 1.0}],
    "sensor_msgs/JointState": [{"name": list("abcdef"), "position": [0.5] * 6}],
}  # fmt: skip
"""For each type, a minute of equal messages of a standing base, or of readings in open space."""


@pytest.mark.parametrize("kind", [kind for kind in PRESETS["sensor"].topics["by"] if kind != "*"])
def test_an_honest_sensor_of_a_base_that_stands_or_in_open_space_stops_nothing(kind: str) -> None:
    for given in HONEST[kind]:
        guard, data = Guarded("sensor", {"by": kind}), message(kind, **given)
        for at in range(0, 60_000, 100):
            guard.tell("by", data, at)
        assert runs(guard, 60_000), given


def test_a_frozen_or_covered_scanner_stops() -> None:
    for ranges in (
        [5.0] * 10 + [math.inf] * 350,
        [5.0] * 360,
        [0.0] * 360,
        [math.nan] * 360,
        [-math.inf] * 360,
    ):
        guard = Guarded("sensor")
        for at in range(0, 3000, 100):
            guard.tell(
                "by", message("sensor_msgs/LaserScan", range_min=0.1, range_max=10.0, ranges=ranges), at
            )
        assert not runs(guard, 3000), ranges[:11]


@pytest.mark.parametrize("charge", [0.2, 1.0, 12.5 / 11.1])
def test_a_battery_may_be_reported_by_its_voltage(charge: float) -> None:
    for most in (1, 1.3):
        guard = Guarded("ready", most=most)
        guard.tell("by", message("sensor_msgs/BatteryState", percentage=charge), 1)
        assert runs(guard, 2) == (charge <= most)


@pytest.mark.parametrize("kind", ["sensor_msgs/Joy", "std_msgs/Header"])
def test_only_the_silence_of_any_other_type_is_judged(kind: str) -> None:
    """A joystick at rest repeats its values; a broken link is silent."""
    guard = Guarded("sensor", {"by": kind}, frozen=2)
    for at in range(0, 1000, 100):
        guard.tell("by", message(kind), at)
        assert runs(guard, at + 1)
    guard.advance(3000)
    assert stops(guard) == [1420]


def trajectory(names: list[str], *points: tuple[Any, ...], stamp: float = 0) -> bytes:
    """Return a trajectory of points, each with its time, positions, and perhaps velocities and accelerations."""
    point = STORE.types["trajectory_msgs/msg/JointTrajectoryPoint"]
    duration = STORE.types["builtin_interfaces/msg/Duration"]
    empty = np.array([], dtype=np.float64)
    made = [
        point(
            positions=np.array(positions, dtype=np.float64),
            velocities=np.array(more[0] if more else [], dtype=np.float64),
            accelerations=np.array(more[1] if len(more) > 1 else [], dtype=np.float64),
            effort=empty,
            time_from_start=duration(sec=int(at), nanosec=round(at % 1 * 1e9)),
        )
        for at, positions, *more in points
    ]
    begin = time_of(stamp)
    return message("trajectory_msgs/JointTrajectory", header__stamp=begin, joint_names=names, points=made)


def time_of(stamp: float) -> dict[str, int]:
    return {"sec": int(stamp), "nanosec": round(stamp % 1 * 1e9)}


JOINTS = ["elbow", "wrist"]


def state(*positions: float, names: list[str] = JOINTS, stamp: float = 0) -> bytes:
    return message("sensor_msgs/JointState", name=names, position=[*positions], header__stamp=time_of(stamp))


@pytest.mark.parametrize(
    ("points", "passes"),
    [
        ([], True),
        ([(0, [0, 0])], False),  # it is over when the controller has it
        ([(0, [0, 0]), (1, [0, 0])], True),
        ([(0.001, [0.1, 0])], True),
        ([(0.001, [0.2, 0])], False),
        ([(-1, [0, 0])], False),
        ([(0, [0, 0]), (0, [0, 0])], False),
        ([(0.4, [1.3, 0])], True),
        ([(0.4, [1.49, 0])], False),
        ([(1, [0, 0]), (2, [1, 1])], True),
        ([(1, [1.5, 2.0]), (2, [-1.5, 0])], True),
        ([(1, [1.51, 0])], False),
        ([(1, [math.nan, 0])], False),
        ([(1, [0])], False),
        ([(1, [])], False),
        ([(1, [0, 0]), (1, [0, 0])], False),
        ([(2, [0, 0]), (1, [0, 0])], False),
        ([(1, [0, 0]), (1.1, [1, 0])], False),
    ],
)
def test_a_trajectory_keeps_the_limits_of_its_joints(points: Any, passes: bool) -> None:
    guard = Guarded("joints", limits="elbow:-1.5..1.5 wrist:-2..2")
    guard.tell("state", state(0, 0), 1)
    for names, good in ((JOINTS, passes), (["elbow", "unknown"], not points), (["elbow"] * 2, not points),
                        ([], not points)):  # fmt: skip
        outcome = guard.tell("command", trajectory(names, *points), 2)
        assert (outcome.result == "passed") == good
        assert good or not fields("trajectory_msgs/JointTrajectory", bytes(outcome.buffer)).points


@pytest.mark.parametrize(
    ("one", "other", "passes"),
    [
        ((0, 1.45, 3.1), (10, 1.45, -3.1), False),
        ((0, 1.45, 3.1), (10, 1.45), True),  # straight
        ((0, 1.45), (10, 1.45, -3.1), True),
        ((0, 1.399, 0.4), (1, 1.399, -0.4), True),  # a parabola, 0.1 high
        ((0, 1.401, 0.4), (1, 1.401, -0.4), False),
        ((0, 1.399, 0.4, 0.0), (1, 1.399, -0.4), True),  # a cubic if one of them has no accelerations
        ((0, 1.401, 0.4), (1, 1.401, -0.4, 0.0), False),
        ((0, -1.17, 0.0), (1, 1.17, 0.0), True),  # 1.5 times its mean velocity
        ((0, -1.18, 0.0), (1, 1.18, 0.0), False),
        ((0, -0.935, 0.0, 0.0), (1, 0.935, 0.0, 0.0), True),  # 1.875 times
        ((0, -0.945, 0.0, 0.0), (1, 0.945, 0.0, 0.0), False),
        ((0, 0.874, 0.0, 20.0), (1, 0.874, 0.0, 20.0), True),  # 20 / 32 high
        ((0, 0.876, 0.0, 20.0), (1, 0.876, 0.0, 20.0), False),
        ((0, 0.0, 0.0), (1, 1.5, 0.0), True),
        ((0, 0.0, 0.0, 0.0), (1, 1.5, 0.0, 0.0), True),
        ((0, 1.4, 0.0, 0.0), (1, 1.5, 0.0, 5.0), False),  # it comes from beyond the limit
        ((0, 1.5, 0.0, 0.0), (1, 1.5, 0.0, 0.0), True),
    ],
)
def test_the_curve_of_a_controller_keeps_the_limits_of_joints(
    one: tuple[float, ...], other: tuple[float, ...], passes: bool
) -> None:
    guard = Guarded("joints", limits="still:0..0 elbow:-1.5..1.5")
    names = ["still", "elbow"]
    for now, side in enumerate((1, -1)):
        guard.tell("state", state(0, side * one[1], names=names), now)
        points = [(at + 0.001, *([0.0, side * value] for value in values)) for at, *values in (one, other)]
        assert (guard.tell("command", trajectory(names, *points), now).result == "passed") == passes


Part = tuple[float, float, float]
"""Seconds of a motion, the acceleration at first, and the jerk."""


def _trapezoid(ramp: float) -> list[Part]:
    return [(ramp, 1 / ramp, 0), (0.83, 0, 0), (ramp, -1 / ramp, 0)]


def _s_curve(ramp: float) -> list[Part]:
    half, jerk = ramp / 2, 4 / ramp**2
    return [(half, 0, jerk), (half, 2 / ramp, -jerk), (0.83, 0, 0), (half, 0, -jerk), (half, -2 / ramp, jerk)]


def _at(parts: list[Part], time: float) -> list[float]:
    """Return the position, velocity and acceleration of a motion to 1 rad/s and back."""
    p = v = a = 0.0
    for length, first, jerk in parts:
        if time <= 0:
            break
        t = min(time, length)
        p += v * t + first * t**2 / 2 + jerk * t**3 / 6
        v, a = v + first * t + jerk * t**2 / 2, first + jerk * t
        time -= length
    return [p, min(v, 1.0), a]


def test_samples_of_a_motion_that_ends_at_a_limit_pass() -> None:
    guard = Guarded("joints", limits="elbow:-1..1.5", vMax=1, aMax=1000)
    cases = itertools.product((_trapezoid, _s_curve), (0.02, 0.05, 0.1, 0.2), (0.7, 0.9, 1.5, 4.3), (2, 3))
    for now, (motion, period, ramp, values) in enumerate(cases):
        parts = motion(ramp * period)
        last = sum(length for length, _first, _jerk in parts)
        end = _at(parts, last)[0]
        points = []
        for at in (*np.arange(0, last - 1e-6, period), last):
            p, *more = _at(parts, at)
            points.append((float(at), [1.5 - (end - p)], *([value] for value in more[: values - 1])))
        guard.tell("state", state(1.5 - end, names=["elbow"]), now * 1000)
        outcome = guard.tell("command", trajectory(["elbow"], *points), now * 1000)
        assert outcome.result == "passed", (motion, period, ramp, values)


def streamed(
    guard: Guarded,
    period: int,
    after: int,
    ahead: float,
    *,
    reports: int = 8,
    lag: int = 0,
    moving: int = 1500,
) -> tuple[float, float, int, int]:
    """Send a point every `period` ms, `after` ms in the future and `ahead` rad beyond the place of a joint then.

    The joint drives straight to the point that passed last, and its place is reported `lag` ms later. Return its place
    and greatest velocity over 0.5 s, and the numbers of points that were sent and that passed.
    """
    place = target = 0.0
    arrives, sent, passing, places = 0, 0, 0, [0.0]
    for now in range(1, moving):
        left = max(arrives - now + 1, 1)
        place += (target - place) / left
        places.append(place)
        if now % reports == 0:
            guard.tell("state", state(places[max(0, now - lag)], names=["elbow"]), now)
        if now % period == 0 and now > 100:
            point = place + ahead
            sent += 1
            if guard.tell("command", trajectory(["elbow"], (after / 1000, [point])), now).result == "passed":
                passing += 1
                target, arrives = point, now + after
    fastest = max((places[at] - places[at - 500]) / 0.5 for at in range(500, moving))
    return place, fastest, sent, passing


@pytest.mark.parametrize(
    ("period", "after", "ahead"),
    [(2, 1, 0.02), (10, 1, 0.06), (20, 1, 0.14), (20, 20, 0.16), (50, 1, 0.14), (20, 200, 0.74)],
)
def test_a_stream_of_points_keeps_the_velocity_of_one_trajectory(
    period: int, after: int, ahead: float
) -> None:
    """MoveIt Servo and jog nodes send points: each is within `jump`, and the joint must not gain it with each one."""
    guard = Guarded("joints", low=-100, high=100)
    _place, fastest, _sent, _passing = streamed(guard, period, after, ahead)
    assert fastest <= 1.1 * 3.2 + 0.15 / 0.5 + 0.1


@pytest.mark.parametrize(
    ("period", "reports", "lag", "part"),
    [(4, 2, 4, 1.0), (8, 8, 8, 0.9), (20, 8, 8, 0.1), (20, 8, 8, 1.0), (33, 10, 5, 1.0), (100, 8, 8, 0.5)],
)
def test_a_stream_of_points_that_keeps_the_velocity_passes(
    period: int, reports: int, lag: int, part: float
) -> None:
    guard = Guarded("joints", low=-100, high=100)
    ahead = part * 3.2 * period / 1000
    place, _fastest, sent, passing = streamed(guard, period, period, ahead, reports=reports, lag=lag)
    assert passing == sent and place > 0.9 * part * 3.2 * 1.3


def test_a_joint_that_was_moved_by_hand_or_wraps_is_taken_where_it_is() -> None:
    guard = Guarded("joints")
    for at, place in ((10, 3.1), (20, -3.1), (30, 0.0), (31, 1.0)):
        guard.tell("state", state(place, 0), at)
        assert guard.tell("command", trajectory(JOINTS, (0.001, [place + 0.1, 0])), at + 1).result == "passed"


def test_a_trajectory_needs_the_present_position_of_each_joint() -> None:
    near = trajectory(JOINTS, (0.001, [0.1, 0]))

    def passes(guard: Guarded, at: int) -> bool:
        return guard.tell("command", near, at).result == "passed"

    guard = Guarded("joints")
    assert not passes(guard, 1)
    guard.tell("state", state(0.1, 0), 10)
    assert passes(guard, 11) and passes(guard, 50) and not passes(guard, 100)
    guard.tell("state", state(0.1, math.nan), 110)
    assert not passes(guard, 110)
    guard = Guarded("joints")
    guard.tell("state", state(0.1, names=["elbow"]), 1)
    assert not passes(guard, 2)
    guard.tell("state", state(0, names=["wrist"]), 3, "/b")
    assert passes(guard, 4)
    guard.tell("state", state(1.0, names=["elbow"]), 5, "/b")
    assert not passes(guard, 6)
    guard.tell("state", state(0, names=["wrist"]), 7, "/b")
    assert passes(guard, 8)
    guard.tell("state", state(0, names=["gripper"]), 9, "/c")
    assert not passes(guard, 10)
    guard = Guarded("joints", jump=9)
    guard.tell("state", state(0.1, 0), 1)
    assert passes(guard, 500) and not passes(guard, 502)  # however far it may jump


RUN = (1.0, [0.6, 0.0], [0.9, 0.0])
"""A point that the elbow passes at 0.9 rad/s, on its way to the limit of 0.68 rad."""


def small_arm(stop_duration: float = 0) -> Guarded:
    return Guarded("joints", low=-1, high=0.68, vMax=1, aMax=5, jump=0.05, stopDuration=stop_duration)


@pytest.mark.parametrize(
    ("before", "at", "stamp", "points", "why"),
    [
        ((), 0.0, -5.0, [(1, [0, 0]), (2, [0, 0])], "of /a of 10.0.0.1 that is over: its last point was 3.000 s ago"),
        ((), 0.0, -1.5, [(1, [0.9, 0]), (2, [0.4, 0])], ""),  # in half a second, at the second point
        ((), 0.0, -1.9, [(1, [0, 0]), (2, [0.4, 0])], "to point 2 of /a of 10.0.0.1 at 0.400 rad in 0.100 s,"),
        ((), 0.0, 5.0, [(1, [0.5, 0])], ""),  # nothing is in force
        ((), 0.0, 5.0, [(1, [1.2, 0])], "has elbow at 1.200 rad"),
        ([RUN], 0.5, 0.3, [(1, [0.5, 0])], "begins in 0.300 s (limit 0.100 s), while elbow moves for 0.5"),
        ([RUN], 0.5, 0.69, [(1, [0.5, 0])], "while elbow moves for 0.500 s, and 0.200 s have to be between them"),
        ([RUN], 0.5, 0.71, [(1, [0.5, 0])], ""),
        ([RUN], 0.5, 0.71, [(0.1, [0.4, 0])], "from 0.600 rad to point 1 of /a of 10.0.0.1 at 0.400 rad in 0.8"),
        ([RUN], 0.5, 0.09, [(0.5, [0.6, 0])], ""),
        # The bridge of a moving joint overshoots the limit; one that stands reaches the same point.
        ([RUN], 0.98, 0.0, [(1, [0.6, 0], [0, 0])], "elbow from 0.588 rad to point 1 of /a of 10.0.0.1 at 0.600 rad"),
        ([RUN], 1.02, 0.0, [(1, [0.6, 0], [0, 0])], ""),
        ([RUN], 0.98, 0.0, [(1, [0.6, 0])], ""),  # straight, without a velocity
        ([RUN], 0.98, 0.0, [(1, [0.6, 0], [0, 0], [0, 0])], "the way of elbow"),
        ([(1, [0.6, 0])], 0.98, 0.0, [(1, [0.6, 0], [0, 0])], "the way of elbow"),
        ([(1, [0.0, 0.6])], 0.98, 0.0, [(1, [0.6, 0], [0, 0])], ""),  # another joint moves
        ((), 0.0, 0.0, [(1, [0, 0], [0, 0]), (2, [0, 0], [0, math.nan])], "wrist at a value that is not a"),
    ],
)  # fmt: skip
def test_a_trajectory_is_judged_as_its_controller_executes_it(
    before: list[tuple[Any, ...]], at: float, stamp: float, points: list[tuple[Any, ...]], why: str
) -> None:
    guard, now = small_arm(), 1 + round(at * 1000)
    guard.tell("state", state(0, 0), 1)
    if before:
        assert guard.tell("command", trajectory(JOINTS, *before), 1).result == "passed"
    place = before[0][1] if before else (0, 0)
    guard.tell("state", state(*(min(at, 1) * one for one in place)), now)
    begins = BEGIN / 1e9 + now / 1000 + stamp if stamp else 0
    outcome = guard.tell("command", trajectory(JOINTS, *points, stamp=begins), now)
    assert (outcome.result == "passed") == (not why), outcome.log
    assert why in "".join(line.text for line in outcome.log)


def test_joints_that_a_trajectory_leaves_out_keep_theirs() -> None:
    rests = trajectory(["elbow"], (1, [0.6], [0.0]))
    guard = small_arm()
    guard.tell("state", state(0, 0), 1)
    for names, point in ((JOINTS, RUN), (["wrist"], (0.1, [0.0]))):
        assert guard.tell("command", trajectory(names, point), 2).result == "passed"
    guard.tell("state", state(0.59, 0), 980)
    assert guard.tell("command", rests, 980).result == "changed"


def test_a_joint_moves_until_its_controller_has_stopped() -> None:
    rests = trajectory(["elbow"], (1, [0.6], [0.0]))
    guard = small_arm(0.5)
    for at, command, passes in (
        (1, rests, True), (2, trajectory(JOINTS), True), (3, rests, False), (500, rests, False), (600, rests, True)
    ):  # fmt: skip
        guard.tell("state", state(0.6, 0), at)
        assert (guard.tell("command", command, at).result == "passed") == passes, at


@pytest.mark.parametrize(
    ("seen", "until", "fails"),
    [(0.6, 1301, False), (0.624, 1301, False), (0.626, 1301, True), (0.3, 1301, True), (0.6, 1050, True),
     (math.nan, 1301, True)],
)  # fmt: skip
def test_a_trajectory_waits_while_the_arm_is_reported_where_it_begins(
    seen: float, until: int, *, fails: bool
) -> None:
    """A goal may be cancelled, and reports may end, while a trajectory waits in the controller."""
    guard = small_arm()
    guard.tell("state", state(0, 0), 1)
    assert guard.tell("command", trajectory(JOINTS, RUN), 1).result == "passed"
    waiting = trajectory(JOINTS, (0, [0.6, 0]), (1, [0, 0]), stamp=BEGIN / 1e9 + 1.301)
    later = trajectory(JOINTS, (0, [0, 0]), (1, [0, 0]), stamp=BEGIN / 1e9 + 3)
    guard.tell("state", state(0.3, 0), 500)
    assert guard.tell("command", waiting, 500).result == "passed"
    guard.got.clear()
    for at in range(520, until, 20):
        guard.tell("state", state(min(at / 1000 * 0.6, seen) if at < 1020 else seen, 0), at)
    guard.advance(1290)
    assert [1251 <= at <= 1271 for at, _stop in guard.got] == [True] * fails
    refused = guard.tell("command", later, 1290)
    assert fails or "and one waits for 0.011 s" in refused.log[0].text


@pytest.mark.parametrize("again", [False, True])
def test_an_empty_trajectory_within_a_stop_waits_for_its_end(*, again: bool) -> None:
    goes, guard = trajectory(["elbow"], (1, [0.1])), small_arm(0.5)
    far, none = trajectory(["elbow"], (1, [9.0])), trajectory([])
    sent = [(1, goes), (100, far), (110, goes), (120, none), *([(130, goes)] if again else [])]
    for at, command in sent:
        guard.tell("state", state(0, 0), at)
        outcome = guard.tell("command", command, at)
        assert outcome.result == {far: "changed", none: "dropped"}.get(command, "passed")
    guard.got.clear()
    guard.advance(700)
    assert [650 <= at <= 670 for at, _stop in guard.got] == ([] if again else [True])


def test_a_stamp_of_a_simulated_clock_counts_as_now() -> None:
    for simulated in (True, False):
        guard = Guarded("joints", simulated=simulated)
        guard.tell("state", state(0, 0), 1)
        given = trajectory(JOINTS, (1, [0, 0]), stamp=12.5)
        assert (guard.tell("command", given, 2).result == "passed") == simulated


@pytest.mark.parametrize("clocks", [[0.2], [-3600], [11, 0], [0, 11], [5, None]])
def test_a_stamp_is_of_the_clock_of_the_nodes_that_report(clocks: list[float | None]) -> None:
    """The clock of the robot is ahead of the guard's: another machine's, or set, or the guard's after a takeover."""
    guard, at = Guarded("joints"), 0

    def passes(begins: float, clock: float | None) -> bool:
        stamp = BEGIN / 1e9 + at / 1000 + (clock or 0) + begins
        return (
            guard.tell("command", trajectory(JOINTS, (0.5, [0.01, 0]), (1, [0, 0]), stamp=stamp), at).result
            == "passed"
        )

    def report(delay: int, clock: float | None) -> None:
        stamp = 0 if clock is None else BEGIN / 1e9 + (at - delay) / 1000 + clock
        guard.tell("state", state(0, 0, stamp=stamp), at)

    for clock in clocks:
        for number in range(320):
            at += 10
            report(200 if number % 7 else 4, clock)  # most of them are late
            assert number < 210 or not passes(-1.1, clock)
        assert passes(-0.9, clock) and passes(0.05, clock) and passes(-0.9, clock)
    at += 3000
    report(0, -20)  # the first after a silence
    assert passes(-0.9, -20)


@pytest.mark.parametrize(("first", "second", "silent", "passes"), [
    (3, 3.02, 0, True), (3, 3.1, 0, False), (3.1, 3, 0, False), (3, None, 0, True), (None, 3, 0, True),
    (3.1, 3, 600, True), (3, 2.96, 0, True), (2.96, 3, 0, True),
])  # fmt: skip
def test_both_nodes_that_report_have_one_clock(
    first: float | None, second: float | None, silent: int, passes: bool
) -> None:
    """One of them alone could say that points are over which the controller will execute."""
    guard = Guarded("joints")
    for node, clock, at in (("/a", first, 1), ("/b", second, 2 + silent)):
        stamp = 0 if clock is None else BEGIN / 1e9 + at / 1000 + clock
        names = ["finger", "thumb"] if silent and node == "/a" else JOINTS
        guard.tell("state", state(0, 0, names=names, stamp=stamp), at, node)
    # It is over in 67 ms by the clock that is ahead by 2.96 s, and has to last 50 ms.
    begins = -0.97 if 2.96 in {first, second} else 0
    command = trajectory(JOINTS, (1, [0, 0]), stamp=BEGIN / 1e9 + 3 + silent / 1000 + begins)
    assert (guard.tell("command", command, 3 + silent).result == "passed") == passes
    without = trajectory(JOINTS, (1, [0, 0]))
    assert guard.tell("command", without, 4 + silent).result == "passed"


def with_id(name: str, before: int, behind: int) -> bytes:
    return bytes(before) + len(name).to_bytes(4, "little") + name.encode() + bytes(behind)


@pytest.mark.complete
def test_a_goal_without_a_result_is_cancelled() -> None:
    guard = Guarded("answer", limit="2s")
    goals = [
        guard.tell("command", with_id(name, 24, 72), at) for name, at in (("a", 1), ("b", 500), ("", 600))
    ]
    assert [goal.result for goal in goals] == ["passed", "passed", "dropped"]
    guard.tell("by", with_id("b", 24, 5), 900)
    guard.tell("by", with_id("a", 24, 5), 950, "/b")
    guard.got.clear()
    guard.advance(10_000)
    assert [(at, fields("actionlib_msgs/GoalID", data).id) for at, data in guard.got] == [(2001, "a")]


@pytest.mark.complete
def test_a_topic_is_withheld_until_all_switches_are_off_and_speak() -> None:
    types, hosts = {"command": "std_msgs/String", "by": "std_msgs/Bool"}, ("10.0.0.7/32", "10.8.0.0/16")
    guard = Guarded("withhold", types, hosts="10.0.0.7 10.8.0.0/16", silent=1)
    assert guard.monitors.withheld_from("/camera/image_raw") == hosts
    for at, on, node, withheld in (
        (1, False, "/a", ()), (900, True, "/a", hosts), (1000, False, "/a", ()),
        (1010, True, "/b", hosts), (1020, False, "/a", hosts), (1030, False, "/b", ()), (1500, False, "/a", ()),
    ):  # fmt: skip
        guard.tell("by", button(on), at, node)
        assert guard.monitors.withheld_from("/camera/image_raw") == withheld
    guard.advance(2000)
    assert guard.monitors.withheld_from("/camera/image_raw") == ()
    guard.advance(2100)
    assert guard.monitors.withheld_from("/camera/image_raw") == hosts
    text = text_of(Guard("guard", PRESETS["withhold"], types=types, values={"hosts": "10.0.0.7 10.8.0.0/16"}))
    assert loaded_values(text) == {"hosts": " ".join(hosts)}
    guard = Guarded("withhold", types, silent=0)
    for place in range(9):
        guard.tell("by", button(False), 1, NODES[place + 1])
        assert bool(guard.monitors.withheld_from("/camera/image_raw")) == (place == 8)


def test_for_an_action_a_stop_drops_goals_and_cancels_all() -> None:
    """An empty goal would not stop an arm."""
    guard = Guarded("estop", {"command": GOAL})
    guard.tell("stop", button(False), 0)
    assert guard.tell("command", with_id("a", 24, 40), 1).result == "passed"
    guard.got.clear()
    guard.tell("stop", button(True), 2)
    [(at, cancel)] = guard.got
    assert (at, fields("actionlib_msgs/GoalID", cancel).id) == (2, "")
    assert guard.tell("command", with_id("b", 24, 40), 3).result == "dropped"
