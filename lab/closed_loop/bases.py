"""A simulated base: it executes the last command until the next, after its lag, and slows at its braking."""

import math
from collections import deque
from dataclasses import dataclass, field

from lab.closed_loop.geometry import Point
from lab.closed_loop.messages import Legs

DIFFERENTIAL, OMNIDIRECTIONAL, STEERED = "differential", "omnidirectional", "steered"


@dataclass
class Base:
    """A base of any outline, with its sensor anywhere on it; by default round, with the sensor in the middle.

    Metres, seconds and radians, but times of commands in ms. The base slows along its motion at `braking`, and gathers
    a velocity in any other direction at `gathering`. Its turn, or its steering angle, changes at `turn_gathering`, by
    default at once. A number that is not finite is its full speed.
    """

    kind: str
    lag: int
    braking: float
    gathering: float
    top: float
    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    turn_top: float = 2.0
    wheelbase: float = 0.4
    vx: float = 0.0
    vy: float = 0.0
    turning: float = 0.0
    turn_gathering: float = math.inf
    """rad/s2; for a steered base rad/s."""
    steered: float = 0.0
    """The steering angle of a steered base, in radians."""
    sensor: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the sensor is, and its direction, in the frame of the base."""
    outline: tuple[Point, ...] = ()
    """Corners in the frame of the base; none: it is round."""
    now: int = 0
    orders: "deque[tuple[int, Legs]]" = field(default_factory=deque)
    wanted: tuple[float, float, float] = (0.0, 0.0, 0.0)
    driven: float = 0.0

    def __post_init__(self) -> None:
        self.full_braking = self.braking

    def order(self, at: int, legs: Legs) -> None:
        self.orders.append((at + self.lag, legs))

    def move(self, until: int) -> None:
        while self.now < until:
            while self.orders and self.orders[0][0] <= self.now:
                self.wanted = self.wanted_by(self.orders.popleft()[1])
            end = min(until, self.now + 10, self.orders[0][0] if self.orders else until)
            self._step((end - self.now) / 1000)
            self.now = end

    @property
    def velocity(self) -> tuple[float, float]:
        """Return the velocity in the frame of the world."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return self.vx * cos - self.vy * sin, self.vx * sin + self.vy * cos

    def wanted_by(self, legs: Legs) -> tuple[float, float, float]:
        """Return the velocities x, y and turning, or the steering angle, that the base takes up for a command."""
        x, y, turning = (legs[place] for place in (0, 1, 5))
        x, y = (one if math.isfinite(one) else math.copysign(self.top, one) for one in (x, y))
        x, y = (max(-1e6, min(1e6, one)) for one in (x, y))
        if self.kind != OMNIDIRECTIONAL:
            y = 0.0
        scale = max(1.0, math.hypot(x, y) / self.top)
        x, y = x / scale, y / scale
        if self.kind == STEERED:
            angle = max(-0.6, min(0.6, turning)) if math.isfinite(turning) else 0.6
            return x, y, angle
        turning = turning if math.isfinite(turning) else self.turn_top
        return x, y, max(-self.turn_top, min(self.turn_top, turning))

    def _turn(self, now: float, wanted: float, seconds: float) -> float:
        most = self.turn_gathering * seconds
        return now + max(-most, min(most, wanted - now))

    def to_world(self, x: float, y: float) -> Point:
        """Return a place in the frame of the base in that of the world."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return self.x + x * cos - y * sin, self.y + x * sin + y * cos

    @property
    def seen_from(self) -> tuple[float, float, float]:
        """Return where the sensor is, and its direction, in the frame of the world."""
        x, y, turned = self.sensor
        return (*self.to_world(x, y), self.heading + turned)

    def _step(self, seconds: float) -> None:
        x, y, turn = self.wanted
        if self.kind == STEERED:
            self.steered = self._turn(self.steered, turn, seconds)
            self.turning = self.vx * math.tan(self.steered) / self.wheelbase
        else:
            self.turning = self._turn(self.turning, turn, seconds)
        before = self.velocity
        dx, dy = x - self.vx, y - self.vy
        # A base that stands sets out in the direction that it is commanded.
        way = (self.vx, self.vy) if self.vx or self.vy else (dx, dy)
        size = math.hypot(*way)
        ux, uy = (way[0] / size, way[1] / size) if size > 0 else (1.0, 0.0)
        along = dx * ux + dy * uy
        across = (dx - along * ux, dy - along * uy)
        along = max(-self.braking * seconds, min(self.gathering * seconds, along))
        size = math.hypot(*across)
        part = min(1.0, self.gathering * seconds / size) if size > 0 else 0.0
        self.vx += along * ux + part * across[0]
        self.vy += along * uy + part * across[1]
        self.heading += self.turning * seconds
        after = self.velocity
        moved = [(one + other) / 2 * seconds for one, other in zip(before, after, strict=True)]
        self.x += moved[0]
        self.y += moved[1]
        self.driven += math.hypot(*moved)
