"""Compute how the simulated LandShark moves, and what its sensors measure, in plain functions without ROS.

Lengths are metres, angles radians (counter-clockwise, 0 is east), times seconds, speeds metres or radians a second.
The world is a flat yard around ORIGIN with one round obstacle in it.
"""

import math
from dataclasses import dataclass
from typing import Any

ORIGIN = (37.4567, -122.1733)  # degrees north, degrees east
EARTH_RADIUS = 6_371_000.0
TOP_SPEED = 2.0
TOP_TURN_RATE = 1.0
COMMAND_LIFETIME = 0.5  # seconds after which a command that is not renewed no longer moves the robot
TURRET_SPEED = 1.5
PAN_LIMITS = (-math.pi, math.pi)
TILT_LIMITS = (-0.8, 0.6)  # below about -0.45 the gun points at the robot itself
DRAIN_IDLE = 0.0005  # fraction of a full battery used each second
DRAIN_MOVING = 0.002  # additional fraction each second at one metre a second


@dataclass(frozen=True)
class Pose:
    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0


@dataclass(frozen=True)
class Velocity:
    forward: float = 0.0
    turn: float = 0.0


@dataclass(frozen=True)
class Turret:
    pan: float = 0.0
    tilt: float = 0.0


@dataclass(frozen=True)
class Obstacle:
    x: float
    y: float
    radius: float


YARD = (Obstacle(x=8.0, y=0.5, radius=1.0),)


def limit(value: float, low: float, high: float) -> float:
    """Return the value within the limits, or their middle if it is not a number."""
    if math.isnan(value):
        return (low + high) / 2
    return min(max(value, low), high)


def pose_of(odometry: Any) -> Pose:
    position, orientation = odometry.pose.pose.position, odometry.pose.pose.orientation
    return Pose(position.x, position.y, 2 * math.atan2(orientation.z, orientation.w))


def normal_angle(angle: float) -> float:
    return math.remainder(angle, math.tau)


def possible(velocity: Velocity) -> Velocity:
    return Velocity(
        forward=limit(velocity.forward, -TOP_SPEED, TOP_SPEED),
        turn=limit(velocity.turn, -TOP_TURN_RATE, TOP_TURN_RATE),
    )


def drive(pose: Pose, velocity: Velocity, seconds: float) -> Pose:
    velocity = possible(velocity)
    turned = velocity.turn * seconds
    if abs(turned) < 1e-9:
        distance = velocity.forward * seconds
        return Pose(
            pose.x + distance * math.cos(pose.heading),
            pose.y + distance * math.sin(pose.heading),
            pose.heading,
        )
    radius = velocity.forward / velocity.turn
    after = pose.heading + turned
    return Pose(
        pose.x + radius * (math.sin(after) - math.sin(pose.heading)),
        pose.y - radius * (math.cos(after) - math.cos(pose.heading)),
        normal_angle(after),
    )


def aim(turret: Turret, wanted: Turret, seconds: float) -> Turret:
    """Return the turret after it has moved toward the wanted angles, within its limits."""
    reach = TURRET_SPEED * seconds
    pan, tilt = limit(wanted.pan, *PAN_LIMITS), limit(wanted.tilt, *TILT_LIMITS)
    return Turret(
        pan=turret.pan + limit(pan - turret.pan, -reach, reach),
        tilt=turret.tilt + limit(tilt - turret.tilt, -reach, reach),
    )


def position_on_earth(pose: Pose) -> tuple[float, float]:
    """Return latitude and longitude in degrees."""
    north, east = ORIGIN
    per_degree = math.radians(1) * EARTH_RADIUS
    return north + pose.y / per_degree, east + pose.x / (per_degree * math.cos(math.radians(north)))


def distance_along(pose: Pose, direction: float, obstacle: Obstacle) -> float:
    """Return the distance to the obstacle in a direction relative to the heading, or infinity if the ray misses it."""
    ray = pose.heading + direction
    to_x, to_y = obstacle.x - pose.x, obstacle.y - pose.y
    ahead = to_x * math.cos(ray) + to_y * math.sin(ray)
    aside_squared = to_x * to_x + to_y * to_y - ahead * ahead
    half_chord_squared = obstacle.radius * obstacle.radius - aside_squared
    if half_chord_squared < 0:
        return math.inf
    half_chord = math.sqrt(half_chord_squared)
    if ahead + half_chord < 0:
        return math.inf  # behind the robot
    return max(ahead - half_chord, 0.0)


def scan(
    pose: Pose, directions: list[float], obstacles: tuple[Obstacle, ...] = YARD, reach: float = 30.0
) -> list[float]:
    """Return the laser's distances, which are infinite beyond its reach."""
    nearest = (min(distance_along(pose, direction, thing) for thing in obstacles) for direction in directions)
    return [distance if distance <= reach else math.inf for distance in nearest]


def drained(charge: float, speed: float, seconds: float) -> float:
    """Return the charge (1 is full) after this time."""
    return max(0.0, charge - (DRAIN_IDLE + DRAIN_MOVING * abs(speed)) * seconds)
