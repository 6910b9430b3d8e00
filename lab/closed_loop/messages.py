"""The bytes of the messages that the simulated nodes send, and the velocities in the messages that a base gets."""

import functools
import math
import struct
from collections.abc import Sequence

import numpy as np

from rosmop.tests.acting import message

Legs = tuple[float, float, float, float, float, float]
"""Linear x, y, z in m/s and angular x, y, z in rad/s; for a steered base the speed, and the steering angle last."""

STILL: Legs = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
EPOCH = 1_700_000_000
"""The second in which every world begins."""

TWIST, TWIST_STAMPED = "geometry_msgs/Twist", "geometry_msgs/TwistStamped"
ACKERMANN, ACKERMANN_STAMPED = "ackermann_msgs/AckermannDrive", "ackermann_msgs/AckermannDriveStamped"
SCAN, ODOMETRY, FIX = "sensor_msgs/LaserScan", "nav_msgs/Odometry", "sensor_msgs/NavSatFix"
POSE, POSE_WITH_COVARIANCE = "geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped"
RANGE, IMU = "sensor_msgs/Range", "sensor_msgs/Imu"
BOOL, JOY = "std_msgs/Bool", "sensor_msgs/Joy"

_SIX, _FIVE = struct.Struct("<6d"), struct.Struct("<5f")
_LARGEST = 3.4e38
_NO_COVARIANCE = bytes(8 * 36)
WGS_84 = 6_378_137.0, 0.00669437999014
"""The greatest radius, in metres, and the square of the eccentricity."""


def header(at: float, frame: bytes = b"f") -> bytes:
    """Return a header with a stamp of `at` ms after the beginning."""
    seconds, rest = divmod(int(at), 1000)
    return struct.pack("<IIII", 0, EPOCH + seconds, rest * 10**6, len(frame)) + frame


def steering(angle: float, speed: float, acceleration: float = 0, jerk: float = 0, rate: float = 0) -> bytes:
    numbers = (angle, rate, speed, acceleration, jerk)
    return _FIVE.pack(*(math.copysign(math.inf, one) if abs(one) > _LARGEST else one for one in numbers))


def encode_steering(kind: str, at: float, fields: Sequence[float]) -> bytes:
    """Return a command of an Ackermann type: steering angle, speed, acceleration, jerk, and rate of the angle."""
    return (header(at) if kind == ACKERMANN_STAMPED else b"") + steering(*fields)


def fields_of(data: bytes) -> tuple[float, ...]:
    """Return the steering angle, its rate, the speed, acceleration and jerk of a command of an Ackermann type."""
    return _FIVE.unpack(data[-_FIVE.size :])


def command(kind: str, legs: Legs, at: float) -> bytes:
    body = steering(legs[5], legs[0]) if kind.startswith("ackermann") else _SIX.pack(*legs)
    return header(at) + body if kind.endswith("Stamped") else body


def legs_of(kind: str, data: bytes) -> Legs:
    if kind.endswith("Stamped"):
        data = data[16 + int.from_bytes(data[12:16], "little") :]
    if kind.startswith("ackermann"):
        angle, _rate, speed, _acceleration, _jerk = _FIVE.unpack(data)
        return (speed, 0.0, 0.0, 0.0, 0.0, angle)
    return _SIX.unpack(data)


def moves(kind: str, legs: Legs) -> bool:
    """Whether a base that gets this command moves or turns. NaN moves it; a steering angle alone does not."""
    return any(leg != 0 for leg in (legs[:1] if kind.startswith("ackermann") else legs))


def travels(legs: Legs) -> bool:
    """Whether it moves to another place."""
    return any(leg != 0 for leg in legs[:3])


def scan(  # noqa: PLR0917  the fields of the message, in their order
    at: float, start: float, step: float, low: float, high: float, ranges: "np.ndarray"
) -> bytes:
    numbers = struct.pack(
        "<7fI", start, start + step * max(0, len(ranges) - 1), step, 0, 0, low, high, len(ranges)
    )
    return header(at) + numbers + ranges.astype("<f4").tobytes() + struct.pack("<I", 0)


def _pose(x: float, y: float, turned: float) -> tuple[float, ...]:
    return (x, y, 0.0, 0.0, 0.0, math.sin(turned / 2), math.cos(turned / 2))


def odometry(at: float, pose: Sequence[float], velocity: Sequence[float] = STILL) -> bytes:
    return (
        header(at) + struct.pack("<I", 1) + b"b" + struct.pack("<7d", *pose) + _NO_COVARIANCE
        + struct.pack("<6d", *velocity) + _NO_COVARIANCE
    )  # fmt: skip


def position(  # noqa: PLR0917  the fields of the message, in their order
    kind: str,
    at: float,
    x: float,
    y: float,
    turned: float,
    quaternion: Sequence[float] = (),
    origin: tuple[float, float] = (0.0, 0.0),
) -> bytes:
    """Return a position in metres, with a heading in rad or a quaternion; a fix is about a latitude and longitude."""
    pose = (*_pose(x, y, turned)[:3], *(quaternion or _pose(x, y, turned)[3:]))
    if kind == ODOMETRY:
        return odometry(at, pose)
    if kind == POSE:
        return header(at) + struct.pack("<7d", *pose)
    if kind == POSE_WITH_COVARIANCE:
        return header(at) + struct.pack("<7d", *pose) + _NO_COVARIANCE
    latitude, (radius, square) = math.radians(origin[0]), WGS_84
    part = 1 - square * math.sin(latitude) ** 2
    north = origin[0] + math.degrees(y * part**1.5 / (radius * (1 - square)))
    east = origin[1] + math.degrees(x * math.sqrt(part) / (radius * math.cos(latitude)))
    return header(at) + struct.pack("<bH3d9dB", 0, 1, north, (east + 180) % 360 - 180, 0.0, *[0.0] * 9, 0)


@functools.cache
def boolean(on: bool) -> bytes:
    return bytes([on])


@functools.cache
def diagnostics(level: int, beside: int = 0) -> bytes:
    """Return an entry, beside an entry of another name; nodes that say it are different nodes."""
    entries = [{"name": "fan", "level": beside}, {"name": "motor", "level": level}]
    return message("diagnostic_msgs/DiagnosticArray", status=entries)


def joy(buttons: Sequence[bool]) -> bytes:
    return header(0) + struct.pack("<II", 0, len(buttons)) + struct.pack(f"<{len(buttons)}i", *buttons)


def battery(charge: float) -> bytes:
    return message("sensor_msgs/BatteryState", percentage=charge)


def values(kind: str, at: float, numbers: Sequence[float]) -> bytes:
    """Return a message of a sensor with these values where the sensor has its measurements."""
    if kind == SCAN:
        return scan(at, -1, 0.1, 0.1, 30, np.array(numbers))
    if kind == RANGE:
        return header(at) + struct.pack("<B4f", 0, 0.1, 0.1, 30, numbers[0])
    if kind == ODOMETRY:
        return odometry(at, numbers[:7])
    if kind == FIX:
        return header(at) + struct.pack("<bH3d9dB", 0, 1, *numbers[:3], *[0.0] * 9, 0)
    covariance = bytes(72)
    assert kind == IMU, kind
    return (
        header(at) + struct.pack("<4d", 0, 0, 0, 1) + covariance + struct.pack("<3d", *numbers[:3]) + covariance
        + struct.pack("<3d", *numbers[3:6]) + covariance
    )  # fmt: skip


VELOCITIES = (TWIST, TWIST, TWIST, TWIST_STAMPED, ACKERMANN, ACKERMANN_STAMPED)
"""The types of commands, `Twist` in half of the worlds."""


def straight(speed: float, turning: float = 0.0) -> Legs:
    return (speed, 0.0, 0.0, 0.0, 0.0, turning)
