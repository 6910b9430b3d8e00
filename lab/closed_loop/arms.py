"""Worlds of `joints`: an arm that executes trajectories, and nodes that report the positions of its joints.

Between two points it drives the curve of joint_trajectory_controller, and to the first one straight.
"""

import math
import struct
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar

from lab.closed_loop.messages import header
from lab.closed_loop.world import COMMAND, NEVER, World

JOINTS: Sequence[str] = ("shoulder", "elbow", "wrist")
TRAJECTORY = "trajectory_msgs/JointTrajectory"
_NEAR = 1e-6
WINDOW = 500
"""The milliseconds in which a joint gains at most one jump."""
OVERSHOOT = 1.1
"""How much of `vMax` a curve between two points may have."""


@dataclass(frozen=True)
class Point:
    at: float
    """Seconds from the start."""
    positions: tuple[float, ...]
    velocities: tuple[float, ...] = ()
    accelerations: tuple[float, ...] = ()


def curve(one: Point, other: Point, joint: int) -> tuple[float, ...]:
    """Return the coefficients of the way between two points, the constant first, as joint_trajectory_controller has it.

    It is a quintic with velocities and accelerations in both points, a cubic with velocities, and otherwise straight.
    """
    p, q, t = one.positions[joint], other.positions[joint], other.at - one.at
    if not (one.velocities and other.velocities):
        return p, (q - p) / t
    v, w = one.velocities[joint] * t, other.velocities[joint] * t
    if not (one.accelerations and other.accelerations):
        return p, v / t, (3 * (q - p) - 2 * v - w) / t**2, (2 * (p - q) + v + w) / t**3
    a, b = one.accelerations[joint] * t**2, other.accelerations[joint] * t**2
    return (
        p,
        v / t,
        a / (2 * t**2),
        (20 * (q - p) - 12 * v - 8 * w - 3 * a + b) / (2 * t**3),
        (30 * (p - q) + 16 * v + 14 * w + 3 * a - 2 * b) / (2 * t**4),
        (12 * (q - p) - 6 * v - 6 * w - a + b) / (2 * t**5),
    )


def on(coefficients: Sequence[float], after: float) -> float:
    """Return the value of a polynomial."""
    return sum(one * after**power for power, one in enumerate(coefficients))


def extremes(points: Sequence[Point], samples: int = 60) -> tuple[float, float]:
    """Return the greatest distance from zero and the greatest velocity of a joint between points, of samples."""
    far = fast = 0.0
    for one, other in pairwise(points):
        for joint in range(len(one.positions)):
            way = curve(one, other, joint)
            velocity = [power * part for power, part in enumerate(way)][1:]
            times = [(other.at - one.at) * sample / samples for sample in range(samples + 1)]
            far = max(far, *(abs(on(way, time)) for time in times))
            fast = max(fast, *(abs(on(velocity, time)) for time in times))
    return far, fast


def _texts(names: Sequence[str]) -> bytes:
    parts = [name.encode() for name in names]
    return struct.pack("<I", len(parts)) + b"".join(struct.pack("<I", len(one)) + one for one in parts)


def _numbers(values: Sequence[float]) -> bytes:
    return struct.pack(f"<I{len(values)}d", len(values), *values)


def trajectory(at: float, names: Sequence[str], points: Sequence[Point]) -> bytes:
    data = header(at) + _texts(names) + struct.pack("<I", len(points))
    for one in points:
        seconds = math.floor(one.at)
        data += (
            _numbers(one.positions) + _numbers(one.velocities) + _numbers(one.accelerations) + _numbers(())
        )
        data += struct.pack("<ii", seconds, round((one.at - seconds) * 1e9))
    return data


def states(at: float, names: Sequence[str], positions: Sequence[float]) -> bytes:
    return header(at) + _texts(names) + _numbers(positions) + _numbers(()) + _numbers(())


class JointsWorld(World):
    """Good and wrong trajectories: out of limits, malformed, or from another place."""

    preset: ClassVar[str] = "joints"
    span = 8000
    one_source: ClassVar[Mapping[str, tuple[str, ...]]] = {"state": ("dead", "half dead")}
    not_yet: ClassVar[Mapping[str, str]] = {
        "switch beside a third node": "the first reporter keeps its place, and the next node gets the other place",
        "cut beside a third node": "as with *switch*",
    }

    def plan(self) -> None:
        r = self.random
        self.live = not self.alone and r.random() < 0.2
        self.fastest, self.most = round(r.uniform(0.5, 3), 2), round(r.uniform(1, 3), 2)
        self.jump, self.silent = round(r.uniform(0.02, 0.2), 2), round(r.uniform(0.1, 0.6), 2)
        self.growth = 20.0
        self.curved = r.choice(("", "", "velocities", "velocities and accelerations"))
        """The values of points beside their positions."""
        self.place = [0.0] * len(JOINTS)
        self.way: tuple[int, list[float], tuple[Point, ...]] = (0, [0.0] * len(JOINTS), ())
        """When the trajectory in force began, the position then, and its points."""
        self.heard: dict[int, int] = {}
        """When each node that has named joints since the guard began did so last with numbers."""
        self.fault = ""
        self.sent = self.passing = 0
        limits = " ".join(f"{name}:{-self.most}..{self.most}" for name in JOINTS) if r.random() < 0.5 else ""
        values = {"vMax": self.fastest, "aMax": self.growth, "jump": self.jump, "silent": self.silent}
        bounds = {"limits": limits} if limits else {"low": -self.most, "high": self.most}
        self.guarded({**values, **bounds}, {"command": TRAJECTORY})
        halves = r.random() < (0.7 if self.alone else 0.4)
        self.reports = {3: JOINTS[:1], 4: JOINTS[1:]} if halves else {3: JOINTS}
        for node, names in self.reports.items():
            period = r.uniform(15, 50 if self.live else self.silent * 800)
            self.every(
                lambda period=period: period * r.uniform(0.7, 1),  # type: ignore[misc]  # bound now
                lambda node=node, names=names: self._report(node, names),  # type: ignore[misc]  # as above
                first=r.uniform(0, 200),
            )
        self.trail: deque[tuple[int, list[float]]] = deque(maxlen=WINDOW // 10)
        """When the joints were where, in the last `WINDOW`."""
        if r.random() < 0.3:
            self._stream()
        else:
            self.every(lambda: r.uniform(300, 1200), self._command, first=600)
        if not self.live:
            self.after(r.uniform(1000, 6000), self._fails)
            self.with_second()
            self.interrupt()

    @property
    def third(self) -> bool:
        """Whether a node may report beside two others."""
        return self.second is not None and len(self.reports) == 2

    def source_of(self, topic: str) -> int:
        return 3

    def ready_acts(self) -> list[str]:
        return [act for act in super().ready_acts() if not self.third or act not in {"switch", "cut"}]

    def begins_again(self) -> None:
        super().begins_again()
        self.forgets()

    def forgets(self) -> None:
        self.heard.clear()

    def counts(self, topic: str) -> bool:
        return self.third  # two nodes may report, and both have to

    def stops_for(self, topic: str) -> float:
        return self.silent * 1000

    def good(self, topic: str) -> bytes:
        return states(self.now, JOINTS, self.place)

    def damages(self, topic: str) -> bool:
        return not self.third

    def _fails(self) -> None:
        self.fault = self.random.choice(
            ("dead", "half dead", "NaN", "no names", "dead" if self.third else "cut")
        )
        self.trace(f"the positions fail: {self.fault}")
        if self.random.random() < 0.5:
            self.after(self.now + self.random.uniform(300, 2000), lambda: setattr(self, "fault", ""))

    def _report(self, node: int, names: Sequence[str]) -> None:
        places = [self.place[JOINTS.index(name)] for name in names]
        match self.fault:
            case "dead":
                return
            case "half dead" if node == max(self.reports):
                return
            case "NaN":
                places = [math.nan] * len(places)
            case "no names" if node not in self.heard:
                self.say(
                    "state", states(self.now, (), places), node
                )  # a node that has named no joint owes none
                return
            case "no names":
                names = ()
            case "cut":
                self.heard[node] = NEVER
                self.say("state", states(self.now, names, places)[:20], node, whole=False)
                return
        self.heard[node] = self.now if self.fault in {"", "half dead"} else NEVER
        self.say("state", states(self.now, names, places), node)

    # Commands

    def _good(self) -> list[Point]:
        r, points = self.random, []
        at, place = 0.0, [*self.place]
        for _point in range(r.choice((1, 2, 5))):
            seconds = r.uniform(0.2, 0.8)
            step = 0.8 * self.fastest * seconds
            place = [
                max(-0.95 * self.most, min(0.95 * self.most, one + r.uniform(-step, step))) for one in place
            ]
            at += seconds
            points.append(Point(at, tuple(place)))
        return self.bent(points, lambda far, fast: far <= 0.99 * self.most and fast <= 0.99 * self.fastest)

    def bent(self, points: list[Point], fits: Callable[[float, float], bool]) -> list[Point]:
        """Return the points with velocities such that the curves between them fit, or else as they are."""
        r = self.random
        for _try in range(20 if self.curved else 0):
            v, a = (r.choice((0.1, 0.5, 1.0)) * most for most in (self.fastest, self.growth))
            made = [
                replace(
                    one,
                    velocities=tuple(r.uniform(-v, v) for _ in JOINTS),
                    accelerations=tuple(r.uniform(-a, a) for _ in JOINTS) if "acc" in self.curved else (),
                )
                for one in points[1:]
            ]
            made = [points[0], *made]  # the way to the first point is straight
            if fits(*extremes(made)):
                return made
        return points

    def _stream(self) -> None:
        """Let a node send points one by one, as MoveIt Servo does: below `vMax`, or with a jump each time."""
        r = self.random
        period, after = r.choice((10, 20, 50, 100)), 200 if self.live else r.choice((1, 20, 200))
        ahead = self.fastest * after / 1000
        ahead = 0.5 * ahead if self.live else r.choice((0.5 * ahead, ahead, ahead + 0.9 * self.jump))
        ways = [r.choice((-1, 1)) for _ in JOINTS]

        def point() -> None:
            for joint, place in enumerate(self.place):
                if abs(place) > 0.6 * self.most:
                    ways[joint] = -1 if place > 0 else 1
            places = (place + way * ahead for place, way in zip(self.place, ways, strict=True))
            self._send(
                "",
                JOINTS,
                [Point(after / 1000, tuple(max(-self.most, min(self.most, one)) for one in places))],
            )

        self.every(lambda: period, point, first=600)

    def _command(self) -> None:
        r = self.random
        bad = "" if self.live else r.choice(("", "", "", *DAMAGE))
        names, points = DAMAGE[bad](self, self._good()) if bad else (JOINTS, self._good())
        if r.random() < 0.05:
            names, points, bad = JOINTS, [], "empty"
        self._send(bad, names, points)

    def _send(self, bad: str, names: Sequence[str], points: list[Point]) -> None:
        self.trace(f"a trajectory of {len(points)} points: {bad or 'good'}")
        data = trajectory(self.now, names, points)
        passed, sent = self.guard.tell(self.guard.topics[COMMAND], data, self.now, self.commander)
        for one in sent:
            self.receive(*one)
        self._judge(bad, points, passes=passed == data)
        if passed is not None:
            driven = passed == data and (not bad or (bad == "curve" and not self.switched_off))
            self.receive(self.now, self.guard.topics[COMMAND], passed, points if driven else ())

    def _judge(self, bad: str, points: Sequence[Point], *, passes: bool) -> None:
        honest = not bad and self.live and self.now > 1000
        self.sent, self.passing = self.sent + honest, self.passing + (honest and passes)
        if self.switched_off or not passes or not points:
            return
        if self.holding or self.guard.holds:
            self.broken("L5", "a trajectory passes a guard that holds")
        if why := self.beside_source():
            self.broken("L4", f"a trajectory passes: {why}")
        law = {"NaN": "L2", "infinite": "L2", "jump": "L3"}.get(bad, "L1")
        if bad:
            self.broken(law, f"a trajectory passes that is wrong: {bad}")
        may_answer = self.second is not None and not self.third
        for node in self.heard if may_answer else self.reports:
            if self.now > self.heard.get(node, NEVER) + self.silent * 1000 and self.now > self.fresh_from:
                self.broken(
                    "L4" if self.foreign else "L2",
                    f"a trajectory passes, and node {node} does not report where the joints are",
                )

    def receive(self, at: int, topic: str, data: bytes, points: Sequence[Point] = ()) -> None:
        """Take a trajectory; one of the guard is empty, and stops the arm where it is."""
        if topic != self.guard.topics[COMMAND]:
            return
        now = max(at, self.now)
        if points and not self.switched_off:
            first = points[0]
            for one, place in zip(first.positions, self.place, strict=False):
                if not abs(one - place) <= self.jump + self.fastest * first.at + _NEAR:
                    self.broken("L3", f"a joint jumps from {place:.3f} to {one:.3f} rad in {first.at:.2f} s")
        self.way = (now, [*self.place], tuple(points))
        self.force = (now, self.force[1])

    def move(self, until: int) -> None:
        began, start, points = self.way
        passed, before = (until - began) / 1000, Point(0.0, tuple(start))
        for one in points:
            if passed <= one.at:
                if one.at > before.at:
                    after = passed - before.at
                    self.place = [on(curve(before, one, joint), after) for joint in range(len(JOINTS))]
                else:
                    self.place = [*one.positions]
                return
            before = one
        self.place = [*before.positions]

    def watch(self) -> None:
        self.trail.append((self.now, [*self.place]))
        began, before = self.trail[0]
        most = self.jump + OVERSHOOT * self.fastest * ((self.now - began) / 1000 + 0.02)
        if not self.switched_off and began > self.fresh_from + 100:
            for place, one in zip(self.place, before, strict=True):
                if not abs(place - one) <= most:
                    self.broken("L3", f"a joint moves from {one:.3f} to {place:.3f} rad since {began} ms")
        if not self.switched_off and any(not abs(one) <= self.most + _NEAR for one in self.place):
            self.broken("L1", f"a joint is out of its limits: {self.place}")

    def ended(self) -> None:
        if self.live and self.passing < 0.95 * self.sent:
            self.broken("live", f"of {self.sent} good trajectories {self.passing} pass")


Damaged = tuple[Sequence[str], list[Point]]


def _first(points: list[Point], **change: object) -> Damaged:
    return JOINTS, [replace(points[0], **change), *points[1:]]  # type: ignore[arg-type]  # fields of a point


def _far(world: JointsWorld, points: list[Point]) -> Damaged:
    return JOINTS, [
        *points[:-1],
        replace(points[-1], positions=(1.01 * world.most, *points[-1].positions[1:])),
    ]


def _jumping(world: JointsWorld, points: list[Point]) -> Damaged:
    return JOINTS, [Point(0.0, tuple(one + 1.5 * world.jump for one in world.place)), *points]


def _fast(world: JointsWorld, points: list[Point]) -> Damaged:
    last = points[-1]
    return JOINTS, [
        *points,
        Point(last.at + 0.01, tuple(0.5 * one - 0.4 * world.most for one in last.positions)),
    ]


def _bending(world: JointsWorld, points: list[Point]) -> Damaged:
    """Return points within the limits, and curves between them that are not."""
    last = points[-1]

    def beyond(far: float, fast: float) -> bool:
        return far >= 1.01 * world.most or fast >= 1.01 * OVERSHOOT * world.fastest

    found = world.bent(points, beyond)
    if beyond(*extremes(found)):
        return JOINTS, found
    out = tuple(math.copysign(world.fastest, one) for one in last.positions)
    home = tuple(-one for one in out)
    long = 8 * world.most / world.fastest + 0.1
    return JOINTS, [
        *points[:-1],
        replace(last, velocities=out, accelerations=()),
        Point(last.at + long, last.positions, home),
    ]


DAMAGE: Mapping[str, Callable[[JointsWorld, list[Point]], Damaged]] = {
    "far": _far,
    "jump": _jumping,
    "fast": _fast,
    "curve": _bending,
    "velocity": lambda world, points: _first(points, velocities=(1.01 * world.fastest, 0.0, 0.0)),
    "acceleration": lambda world, points: _first(points, accelerations=(0.0, -1.01 * world.growth, 0.0)),
    "NaN": lambda _world, points: (
        JOINTS,
        [*points[:-1], replace(points[-1], positions=(math.nan, 0.0, 0.0))],
    ),
    "infinite": lambda _world, points: _first(points, positions=(math.inf, 0.0, 0.0)),
    "names": lambda _world, points: (JOINTS[:2], points),
    "unknown": lambda _world, points: ((*JOINTS[:2], "gripper"), points),
    "twice": lambda _world, points: ((*JOINTS[:2], JOINTS[0]), points),
    "backwards": lambda _world, points: (JOINTS, [*points, points[-1]]),
    "minus": lambda _world, points: _first(points, at=-0.5),
    "short": lambda _world, points: _first(points, positions=points[0].positions[:2]),
    "long velocities": lambda _world, points: _first(points, velocities=(0.0,) * 4),
    "no names": lambda _world, points: ((), points),
}
"""Wrong trajectories, made of a good one."""
