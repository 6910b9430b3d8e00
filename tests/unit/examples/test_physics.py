import importlib.util
import math
import sys
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import given
from hypothesis import strategies as st

FILE = Path(__file__).parents[3] / "examples" / "landshark" / "nodes" / "physics.py"


def load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("landshark_physics", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


physics = load()
angles = st.floats(-math.pi, math.pi)
speeds = st.floats(-3, 3)
seconds = st.floats(0.001, 5)


def test_straight_ahead() -> None:
    pose = physics.drive(physics.Pose(0, 0, math.pi / 2), physics.Velocity(1.0, 0.0), 2.0)
    assert (pose.x, pose.y) == (pytest.approx(0), pytest.approx(2))


def test_full_circle() -> None:
    pose = physics.drive(physics.Pose(3, 4, 0.5), physics.Velocity(1.0, 0.5), math.tau / 0.5)
    assert (pose.x, pose.y, pose.heading) == (pytest.approx(3), pytest.approx(4), pytest.approx(0.5))


@given(heading=angles, forward=speeds, turn=speeds, first=seconds, second=seconds)
def test_steps_add_up(heading: float, forward: float, turn: float, first: float, second: float) -> None:
    velocity = physics.Velocity(forward, turn)
    start = physics.Pose(0, 0, heading)
    whole = physics.drive(start, velocity, first + second)
    parts = physics.drive(physics.drive(start, velocity, first), velocity, second)
    assert math.hypot(whole.x - parts.x, whole.y - parts.y) < 1e-5
    assert abs(physics.normal_angle(whole.heading - parts.heading)) < 1e-6


@given(forward=st.floats(), turn=st.floats())
def test_motors_have_limits(forward: float, turn: float) -> None:
    velocity = physics.possible(physics.Velocity(forward, turn))
    assert abs(velocity.forward) <= physics.TOP_SPEED
    assert abs(velocity.turn) <= physics.TOP_TURN_RATE


@given(pan=st.floats(), tilt=st.floats(), step=seconds)
def test_turret_has_limits(pan: float, tilt: float, step: float) -> None:
    turret = physics.aim(physics.Turret(), physics.Turret(pan, tilt), step)
    assert physics.TILT_LIMITS[0] <= turret.tilt <= physics.TILT_LIMITS[1]
    assert physics.PAN_LIMITS[0] <= turret.pan <= physics.PAN_LIMITS[1]
    assert max(abs(turret.pan), abs(turret.tilt)) <= physics.TURRET_SPEED * step + 1e-9


def test_turret_arrives() -> None:
    turret = physics.Turret()
    for _ in range(100):
        turret = physics.aim(turret, physics.Turret(1.0, -0.5), 0.05)
    assert (turret.pan, turret.tilt) == (pytest.approx(1.0), pytest.approx(-0.5))


def test_laser_sees_the_obstacle() -> None:
    thing = physics.Obstacle(x=3, y=0, radius=1)
    ahead, left, behind = physics.scan(physics.Pose(), [0.0, math.pi / 2, math.pi], (thing,))
    assert ahead == pytest.approx(2)
    assert math.isinf(left)
    assert math.isinf(behind)


def test_laser_has_a_maximum_range() -> None:
    assert physics.scan(physics.Pose(), [0.0], (physics.Obstacle(50, 0, 1),), reach=30.0) == [math.inf]


def test_position_on_earth() -> None:
    assert physics.position_on_earth(physics.Pose()) == physics.ORIGIN
    north, east = physics.position_on_earth(physics.Pose(x=0, y=111_195))
    assert (north - physics.ORIGIN[0], east) == (pytest.approx(1, abs=1e-4), physics.ORIGIN[1])


def test_battery_is_never_negative() -> None:
    assert physics.drained(1.0, 1.0, 10) < physics.drained(1.0, 0.0, 10) < 1.0
    assert physics.drained(0.001, 2.0, 1000) == 0.0
