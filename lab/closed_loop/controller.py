"""joint_trajectory_controller of ros_controllers, as its published source moves an arm; times are seconds.

Written from `init_joint_trajectory.h`, `joint_trajectory_msg_utils.h`, `quintic_spline_segment.h`,
`stop_trajectory_builder.h` and `joint_trajectory_controller_impl.h` of its branch for Noetic, without reading `joints`:

- A trajectory begins at its stamp, or at the next update without one. Its points that are over then are dropped; when
  none is left, when their times do not grow, or when its joints are not those of the controller, the old one goes on.
- Until it begins the old one goes on. Then one bridge leads from the state there to the first point that is left.
- A segment is a quintic, a cubic or straight, by what both ends have. The state of the old trajectory has all three
  values, so the first point alone decides about the bridge.
- Joints that are left out keep what they do, if `partial`; else such a trajectory is rejected.
- An empty trajectory and a cancelled goal stop each joint: at once, or in `stopping` seconds.
- No velocity, acceleration or position is limited. Tolerances abort a goal, and change no motion.

Left out: joints that turn without an end, to whose positions it adds whole turns.
"""

import bisect
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

State = tuple[float, ...]
"""The position, the velocity and the acceleration of a joint, or the first of them."""


@dataclass(frozen=True)
class Point:
    at: float
    """Seconds from the start."""
    positions: tuple[float, ...]
    velocities: tuple[float, ...] = ()
    accelerations: tuple[float, ...] = ()

    def of(self, joint: int) -> State:
        if not self.velocities:
            return (self.positions[joint],)
        return tuple(each[joint] for each in (self.positions, self.velocities, self.accelerations) if each)


class Segment(NamedTuple):
    begin: float
    seconds: float
    parts: Sequence[float]
    """The coefficients of the polynomial, the constant first."""

    def state(self, time: float) -> State:
        after = time - self.begin
        inside = min(max(after, 0.0), self.seconds)
        p = v = a = 0.0
        for part in reversed(self.parts):
            p, v, a = p * inside + part, v * inside + p, a * inside + 2 * v
        return (p, v, a) if inside == after else (p, 0.0, 0.0)

    def looks(self, begin: float, end: float) -> Iterator[float]:
        """Yield the times between these two at which a short segment is to be looked at, and when it begins."""
        for part in range(9 if self.seconds < 0.02 else 1):
            time = self.begin + self.seconds * part / 8
            if begin < time < end:
                yield time


def segment(begin: float, state: State, end: float, other: State) -> Segment:
    t = end - begin
    p, d = state[0], other[0] - state[0]
    if t == 0:
        return Segment(
            begin, 0.0, (p, *(each / (1 + power) for power, each in enumerate(state[1 : len(other)])))
        )
    if min(len(state), len(other)) == 1:
        return Segment(begin, t, (p, d / t))
    v, w = state[1] * t, other[1] * t
    if min(len(state), len(other)) == 2:
        return Segment(begin, t, (p, v / t, (3 * d - 2 * v - w) / t**2, (v + w - 2 * d) / t**3))
    a, b = state[2] * t**2, other[2] * t**2
    return Segment(begin, t, (
        p, v / t, a / (2 * t**2),
        (20 * d - 12 * v - 8 * w - 3 * a + b) / (2 * t**3),
        (-30 * d + 16 * v + 14 * w + 3 * a - 2 * b) / (2 * t**4),
        (12 * d - 6 * v - 6 * w - a + b) / (2 * t**5),
    ))  # fmt: skip


def extremes(points: Sequence[Point], samples: int = 60) -> tuple[float, float]:
    """Return the greatest distance from zero and the greatest velocity of a joint between points, of samples."""
    far = fast = 0.0
    for point, other in pairwise(points):
        for joint in range(len(point.positions)):
            way = segment(point.at, point.of(joint), other.at, other.of(joint))
            for sample in range(samples + 1):
                p, v, _a = way.state(point.at + way.seconds * sample / samples)
                far, fast = max(far, abs(p)), max(fast, abs(v))
    return far, fast


class Controller:
    """The controller of an arm that follows it exactly."""

    def __init__(
        self, joints: Sequence[str], *, period: float, partial: bool, stopping: float, begin: float = 0.0
    ) -> None:
        self.joints, self.period, self.partial, self.stopping = joints, period, partial, stopping
        self.ways = [[Segment(begin, 0.0, (0.0,))] for _ in joints]

    def state(self, joint: int, time: float) -> State:
        way = self.ways[joint]
        return way[self._active(way, time)].state(time)

    @staticmethod
    def _active(way: Sequence[Segment], time: float) -> int:
        return max(0, bisect.bisect_right(way, time, key=lambda each: each.begin) - 1)

    def last_update(self, now: float) -> float:
        return math.floor(now / self.period) * self.period

    def stop(self, now: float) -> None:
        now = self.last_update(now)
        for joint, way in enumerate(self.ways):
            p, v, _a = self.state(joint, now)
            if not self.stopping:
                way[:] = [Segment(now, 0.0, (p,))]
                continue
            there = segment(now, (p, v, 0.0), now + 2 * self.stopping, (p, -v, 0.0)).state(
                now + self.stopping
            )
            way[:] = [segment(now, (p, v, 0.0), now + self.stopping, there)]

    def take(self, now: float, names: Sequence[str], stamp: float | None, points: Sequence[Point]) -> bool:
        """Take a trajectory without a stamp (None) or with one; return whether it has replaced the old one."""
        if not points:
            self.stop(now)
            return True
        now = self.last_update(now) + self.period
        begin = now if stamp is None else stamp
        left = [point for point in points if begin + point.at > now]
        if (
            not left
            or any(point.at >= other.at for point, other in pairwise(points))
            or not names
            or not set(names) <= set(self.joints)
            or (len(names) > len(self.joints) if self.partial else len(names) != len(self.joints))
            or any(len(one.positions) != len(names) for one in left)
            or any(
                len(each) not in {0, len(names)}
                for one in left
                for each in (one.velocities, one.accelerations)
            )
            or left[0].at < 0
        ):
            return False
        start, first = max(begin, now), begin + left[0].at
        for place, name in enumerate(names):
            joint = self.joints.index(name)
            old = self.ways[joint]
            kept = old[self._active(old, now - self.period) : self._active(old, start) + 1]
            bridge = segment(start, self.state(joint, start), first, left[0].of(place))
            rest = [
                segment(begin + one.at, one.of(place), begin + other.at, other.of(place))
                for one, other in pairwise(left)
            ]
            self.ways[joint] = [*kept, bridge, *rest]
        return True
