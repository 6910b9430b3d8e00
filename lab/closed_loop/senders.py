"""The senders of trajectories in worlds of `joints`: honest ones as robots have them, and hostile or faulty ones.

Each knows where the joints are only from their reports, and sends by `JointsWorld.send`.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from lab.closed_loop.controller import Point, extremes, segment

if TYPE_CHECKING:
    from lab.closed_loop.arms import JointsWorld

JOINTS: Sequence[str] = ("shoulder", "elbow", "wrist")
OVERSHOOT = 1.1
"""How much of `vMax` a curve may have."""


class Sent(NamedTuple):
    """A trajectory; a `stamp` is seconds from the beginning of the world, None is zero."""

    points: Sequence[Point]
    stamp: float | None = None
    names: Sequence[str] = JOINTS
    bad: str = ""


def line(
    start: Sequence[float], goal: Sequence[float], fastest: float, growth: float, step: float, *, smooth: bool
) -> list[Point]:
    """Return the samples of a straight way of all joints, as a planner times it: smooth, or a ramp."""
    way = [other - one for one, other in zip(start, goal, strict=True)]
    far = max(1e-6, *map(abs, way))
    v, a = fastest / far, growth / far
    if smooth:
        seconds = max(1.875 / v, math.sqrt(5.78 / a))
    else:
        v = min(v, math.sqrt(a))
        seconds = 1 / v + v / a
    number = max(1, math.ceil(seconds / step))

    def share(at: float) -> tuple[float, float, float]:
        if smooth:
            s = at / seconds
            return (
                s**3 * (10 - 15 * s + 6 * s * s),
                30 * s * s * (1 - s) ** 2 / seconds,
                60 * s * (1 - s) * (1 - 2 * s) / seconds**2,
            )
        if at <= v / a:
            return a * at * at / 2, a * at, a
        if at >= seconds - v / a:
            return 1 - a * (seconds - at) ** 2 / 2, a * (seconds - at), -a
        return v * (at - v / a / 2), v, 0.0

    points = []
    for sample in range(number + 1):
        at = seconds * sample / number
        part = share(at)
        points.append(Point(
            at, tuple(p + d * part[0] for p, d in zip(start, way, strict=True)),
            tuple(d * part[1] for d in way), tuple(d * part[2] for d in way),
        ))  # fmt: skip
    return points


def bare(points: Sequence[Point], has: int) -> list[Point]:
    """Return the points with their positions (0), with velocities (1), or also with accelerations (2)."""
    return [
        replace(one, velocities=one.velocities * (has > 0), accelerations=one.accelerations * (has > 1))
        for one in points
    ]


Sends = Iterator[float]
"""Yields the seconds until a sender goes on."""


def plans(w: "JointsWorld") -> Sends:
    """MoveIt: from rest, in samples of 0.03 or 0.1 s."""
    r = w.random
    while True:
        if w.still:
            points = w.route(r.choice((0.1, 0.5, 0.9)), r.choice((0.03, 0.1)), has=r.choice((0, 1, 1, 2)))
            w.send(Sent(points, r.choice((None, None, w.time, w.time + 0.05))), honest=True)
        yield r.uniform(0.05, 0.3)


def dense(w: "JointsWorld") -> Sends:
    """A Cartesian planner: a short way in samples of 20 ms."""
    r = w.random
    while True:
        if w.still:
            goal = [max(-0.9 * w.most, min(0.9 * w.most, one + r.uniform(-0.2, 0.2))) for one in w.told]
            points = line(w.told, goal, 0.3 * w.fastest, 2.0, 0.02, smooth=True)
            if len(points) < 60:
                w.send(Sent(bare(points, r.choice((1, 2)))), honest=True)
        yield r.uniform(0.05, 0.3)


def servo(w: "JointsWorld") -> Sends:
    """MoveIt Servo and jog nodes: one point in the next period, from the reported positions."""
    r = w.random
    period, has, now = r.choice((0.02, 0.034)), r.choice((0, 1)), [0.0] * len(JOINTS)
    while True:
        wanted = [r.choice((-0.4, 0, 0.2, 0.4)) * w.fastest for _ in JOINTS]
        for _point in range(r.randrange(20, 60)):
            for joint, place in enumerate(w.told):
                if abs(place) > 0.6 * w.most:
                    wanted[joint] = -math.copysign(0.4 * w.fastest, place)
                now[joint] += 0.15 * (wanted[joint] - now[joint])
            places = tuple(one + v * period for one, v in zip(w.told, now, strict=True))
            w.send(Sent(bare([Point(period, places, tuple(now))], has)), honest=True)
            yield period


def sliders(w: "JointsWorld") -> Sends:
    """rqt_joint_trajectory_controller: 10 Hz, one point with positions, in motion."""
    r = w.random
    while True:
        goal = [r.uniform(-0.9, 0.9) * w.most for _ in JOINTS]
        for _drag in range(r.randrange(1, 20)):
            seconds = max(0.5, *(abs(one - p) / w.fastest for one, p in zip(goal, w.told, strict=True))) / 0.5
            w.send(Sent([Point(seconds, tuple(goal))]), honest=True)
            goal = [max(-0.9 * w.most, min(0.9 * w.most, one + r.uniform(-0.1, 0.1))) for one in goal]
            yield 0.1
        yield r.uniform(0.2, 1.5)


def partial(w: "JointsWorld") -> Sends:
    r = w.random
    while True:
        if w.still:
            chosen = sorted(r.sample(range(len(JOINTS)), r.choice((1, 2))))
            w.send(part(w.route(r.choice((0.2, 0.8)), 0.1, has=r.choice((0, 1, 2))), chosen), honest=True)
        yield r.uniform(0.05, 0.3)


def queued(w: "JointsWorld") -> Sends:
    """Goals that begin once the one before is known to have ended, sent while it moves."""
    r = w.random
    while True:
        if w.still:
            first = w.route(r.choice((0.5, 0.9)), 0.1, has=r.choice((0, 1, 2)))
            begin = w.time + 0.05
            w.send(Sent(first, begin), honest=True)
            yield r.uniform(0.02, 0.3)
            then = w.route(0.5, 0.1, has=r.choice((0, 1, 2)), start=first[-1].positions)
            w.send(
                Sent(then, begin + first[-1].at + max(r.choice((0.21, 0.25, 0.5)), w.jump / w.fastest)),
                honest=True,
            )
        yield r.uniform(0.05, 0.3)


def cancelling(w: "JointsWorld") -> Sends:
    """Goals that are cancelled in motion, each with a new plan once the arm stands."""
    r = w.random
    while True:
        if w.still:
            points = w.route(r.choice((0.5, 0.9)), 0.1, has=r.choice((0, 1, 2)))
            if w.send(Sent(points), honest=True):
                yield r.uniform(0.1, 0.9) * points[-1].at
                w.cancel()
        yield 0.1


def blend(w: "JointsWorld") -> Sends:
    """A planner that leaves its own plan 0.3 s ahead, in motion and without a halt."""
    r = w.random
    while True:
        if w.still:
            w.send(Sent(w.route(0.5, 0.1, has=2)), honest=True)
        else:
            now = [w.controller.state(joint, w.time + 0.3) for joint in range(len(JOINTS))]
            goal = [r.uniform(-0.8, 0.8) * w.most for _ in JOINTS]
            seconds = 1 + 3 * max(abs(one[0] - p) for one, p in zip(now, goal, strict=True)) / w.fastest
            ways = [segment(0.3, one, 0.3 + seconds, (p, 0.0, 0.0)) for one, p in zip(now, goal, strict=True)]
            number = math.ceil(seconds / 0.1)
            points = []
            for sample in range(number + 1):
                at = 0.3 + seconds * sample / number
                points.append(Point(at, *zip(*(way.state(at) for way in ways), strict=True)))
            far, fast = extremes(points, 12)
            if far < w.most and fast < w.fastest:
                w.send(Sent(points), honest=True)
        yield r.uniform(0.2, 0.6)


def part(points: Sequence[Point], joints: Sequence[int]) -> Sent:
    """Return a trajectory of some of the joints."""

    def of(values: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(values[joint] for joint in joints) if values else ()

    found = [replace(one, positions=of(one.positions), velocities=of(one.velocities),
                     accelerations=of(one.accelerations)) for one in points]  # fmt: skip
    return Sent(found, names=[JOINTS[joint] for joint in joints])


def past(w: "JointsWorld") -> None:
    r = w.random
    points = w.route(0.9, r.choice((0.1, 1.0)), has=r.choice((0, 1, 2)))
    w.send(Sent(points, w.time - r.uniform(0, points[-1].at + 0.2)))


def future(w: "JointsWorld") -> None:
    r = w.random
    w.send(Sent(w.route(0.5, 0.1, has=r.choice((0, 1, 2))), w.time + r.choice((0.08, r.uniform(0.05, 2.5)))))
    if r.random() < 0.5:
        w.send(Sent(w.route(0.9, 0.1, has=r.choice((0, 1, 2)))))


def elsewhere(w: "JointsWorld") -> None:
    """A queued goal that does not begin where the one before ends, or not when."""
    r = w.random
    start = [r.uniform(-0.9, 0.9) * w.most for _ in JOINTS]
    w.send(
        Sent(
            w.route(0.5, 0.1, has=r.choice((0, 1, 2)), start=start),
            max(w.ends, w.time) + r.uniform(-0.3, 0.5),
        )
    )


def near(w: "JointsWorld", t: float) -> tuple[float, ...]:
    r = w.random
    ways = (r.choice((-1, 0.5, 1)) * (0.9 * w.jump + r.uniform(0, 0.9) * w.fastest * t) for _ in JOINTS)
    return tuple(max(-w.most, min(w.most, one + way)) for one, way in zip(w.told, ways, strict=True))


def point(w: "JointsWorld", t: float) -> Point:
    """A near point with velocities and accelerations that are permitted in a point."""
    r = w.random
    v, a = (r.choice((0.3, 1.0)) * most for most in (w.fastest, w.growth))
    velocities, accelerations = (tuple(r.choice((-most, most)) for _ in JOINTS) for most in (v, a))
    [found] = bare([Point(t, near(w, t), velocities, accelerations)], r.choice((0, 1, 2)))
    return found


def preempt(w: "JointsWorld") -> None:
    w.send(
        Sent(
            [point(w, w.random.choice((0.01, 0.05, 0.2, 0.5)))], w.random.choice((None, None, w.time + 0.05))
        )
    )


def edge(w: "JointsWorld") -> None:
    """Preempt with a point at a limit, at any velocity there."""
    r = w.random
    sides = [math.copysign(w.most - r.choice((0, 0.02)), one or 1) for one in w.told]
    t = max(abs(side - p) for side, p in zip(sides, w.told, strict=True)) / (0.9 * w.fastest) + r.choice(
        (0.0, 0.2)
    )
    v = tuple(r.choice((-1, 0, 1)) * w.fastest for _ in JOINTS)
    w.send(Sent(bare([Point(t + 0.01, tuple(sides), v, (0.0,) * 3)], r.choice((0, 1, 2)))))


def wild(w: "JointsWorld") -> None:
    one = point(w, w.random.choice((0.1, 0.3, 1.0)))
    w.send(Sent([one, replace(one, at=one.at + 0.5)]))


def stream(w: "JointsWorld") -> Sends:
    """Points one by one: below `vMax`, at it, or with a jump each time."""
    r = w.random
    period, after = r.choice((0.01, 0.02) if w.tight else (0.02, 0.05, 0.1)), r.choice((0.001, 0.02, 0.2))
    ahead = r.choice((1,) if w.tight else (0.5, 1)) * w.fastest * after
    ahead += 0.9 * w.jump if w.tight else r.choice((0, 0.9 * w.jump))
    ways = [r.choice((-1, 1)) for _ in JOINTS]
    while True:
        for joint, place in enumerate(w.told):
            if abs(place) > 0.6 * w.most:
                ways[joint] = -1 if place > 0 else 1
        places = (max(-w.most, min(w.most, one + way * ahead)) for one, way in zip(w.told, ways, strict=True))
        w.send(Sent([Point(after, tuple(places))]))
        yield period


def halves(w: "JointsWorld") -> None:
    """Two nodes with goals for some joints each, at other times."""
    r = w.random
    chosen = sorted(r.sample(range(len(JOINTS)), r.choice((1, 2))))
    points = r.choice(
        (lambda: [point(w, r.choice((0.05, 0.3)))], lambda: w.route(0.9, 0.1, has=r.choice((0, 1, 2))))
    )()
    stamp = r.choice((None, None, w.time + r.uniform(-0.5, 0.5)))
    w.send(part(points, chosen)._replace(stamp=stamp), r.choice((1, 2)))


def refused(w: "JointsWorld") -> None:
    """A trajectory that the controller rejects, and a later one that fits it."""
    r = w.random
    sent = part(w.route(0.9, 0.1, has=0), (0,))
    w.send(sent)
    end = [sent.points[-1].positions[0], *w.told[1:]]
    w.send(Sent(w.route(0.5, 0.1, has=r.choice((0, 1, 2)), start=end), w.time + sent.points[-1].at))


def replay(w: "JointsWorld") -> None:
    r = w.random
    if not w.kept or r.random() < 0.3:
        w.kept.append(Sent(w.route(0.9, 0.1, has=r.choice((0, 1, 2))), w.time))
        w.send(w.kept[-1])
    else:
        w.send(r.choice(w.kept[-3:]))


def unstopped(w: "JointsWorld") -> Sends:
    """Wrong trajectories again and again, in motion: each is a stop."""
    r = w.random
    while True:
        if w.still:
            w.send(Sent(w.route(0.9, 0.1, has=r.choice((0, 1, 2)))))
            yield r.uniform(0.2, 0.8)
        for _wrong in range(r.randrange(2, 40)):
            if r.random() < 0.2:  # the controller rejects it, or the other joints go on to stop
                w.send(part(w.route(0.9, 0.1, has=0), (0,)))
            w.send(Sent([Point(0.5, (2 * w.most, 0.0, 0.0))], bad="far"))
            yield 0.02
        yield r.uniform(0.1, 0.5)


def cancelled(w: "JointsWorld") -> float:
    """A goal that begins where a cancelled one would have ended, at that time or later."""
    r = w.random
    start = [way[-1].state(math.inf)[0] for way in w.controller.ways]
    if w.ends <= w.time:
        return 0.1
    begin = w.ends + r.choice((0.0, 0.21, 0.4))
    w.cancel()
    w.send(Sent(w.route(0.5, 0.1, has=r.choice((0, 1, 2)), start=start), begin))
    return begin - w.time + 0.5


def make_sent(w: "JointsWorld", bad: str) -> Sent:
    names, points = DAMAGE[bad](w, w.walk())
    return Sent(points, names=names, bad=bad)


def wrong(w: "JointsWorld", bad: str = "") -> None:
    bad = bad or w.random.choice([*DAMAGE])
    w.send(Sent((), bad=bad) if bad == "empty" else make_sent(w, bad))
    if w.random.random() < 0.3:  # a goal that is wrong stops nothing
        preempt(w)


def damage(w: "JointsWorld") -> Sends:
    """Each kind of wrong trajectory, in any order, with good ones between them."""
    r = w.random
    while True:
        for bad in r.sample(["empty", "curve", *DAMAGE], 2 + len(DAMAGE)):
            w.curved = r.choice(("velocities", "velocities and accelerations"))
            if r.random() < 0.2:
                w.send(Sent(w.walk()))
                yield r.uniform(0.1, 0.4)
            wrong(w, bad)
            yield r.uniform(0.1, 0.4)


def mix(w: "JointsWorld") -> None:
    w.random.choice([*ACTS.values()])(w)


def beside(act: Callable[["JointsWorld"], float | None]) -> Callable[["JointsWorld"], Sends]:
    """Return a sender that does this in the motions of an honest planner, and before and after them."""

    def sends(w: "JointsWorld") -> Sends:
        r = w.random
        while True:
            if w.still and r.random() < 0.7:
                points = w.route(r.choice((0.5, 0.9)), 0.1, has=r.choice((0, 1, 2)), far=0.6)
                w.send(Sent(points))
                yield r.choice((0.0, r.uniform(0, 1) * points[-1].at))
            pause = act(w)
            yield r.uniform(0.02, 0.7) if pause is None else pause

    return sends


Damaged = tuple[Sequence[str], list[Point]]


def _first(points: list[Point], **change: object) -> Damaged:
    return JOINTS, [replace(points[0], **change), *points[1:]]  # type: ignore[arg-type]  # fields of a point


def _far(world: "JointsWorld", points: list[Point], side: int = 1) -> Damaged:
    """Return a way to a point beyond the limits, slow enough."""
    last, out = points[-1], tuple(side * 1.01 * world.most for _ in JOINTS[1:])
    at = last.at + 4 * world.most / world.fastest
    return JOINTS, [*points, Point(at, (last.positions[0], *out))]


def _jumping(world: "JointsWorld", points: list[Point]) -> Damaged:
    """Return a way that jumps at once; the controller leaves out a point at the time 0, and moves to the next one."""
    far = 1.5 * world.jump + 0.01 * OVERSHOOT * world.fastest
    return JOINTS, [Point(0.01, tuple(one + far for one in world.place)), *points]


def _fast(world: "JointsWorld", points: list[Point]) -> Damaged:
    last = points[-1]
    return JOINTS, [
        *points,
        Point(last.at + 0.01, tuple(0.5 * position - 0.4 * world.most for position in last.positions)),
    ]


def _quick(world: "JointsWorld", _points: list[Point]) -> Damaged:
    """Return a point that a joint at rest reaches with a constant acceleration, and passes too fast."""
    t = min(0.4, world.most / world.fastest)
    ways = [math.copysign(1.01 * world.fastest, -one or 1) for one in world.place]
    places = tuple(one + way * t / 2 for one, way in zip(world.place, ways, strict=True))
    return JOINTS, [Point(t, places, tuple(ways))]


def _bending(world: "JointsWorld", points: list[Point]) -> Damaged:
    """Return points within the limits, and curves between them that are not."""
    last = points[-1]

    def beyond(far: float, fast: float) -> bool:
        return far >= 1.01 * world.most or fast >= 1.01 * OVERSHOOT * world.fastest

    found = world.bend(points, beyond)
    if beyond(*extremes(found)):
        return JOINTS, found
    out = tuple(math.copysign(world.fastest, position) for position in last.positions)
    home = tuple(-one for one in out)
    long = 8 * world.most / world.fastest + 0.1
    return JOINTS, [
        *points[:-1],
        replace(last, velocities=out, accelerations=()),
        Point(last.at + long, last.positions, home),
    ]


DAMAGE: Mapping[str, Callable[["JointsWorld", list[Point]], Damaged]] = {
    "far": _far,
    "low": lambda world, points: _far(world, points, -1),
    "jump": _jumping,
    "fast": _fast,
    "curve": _bending,
    "velocity": _quick,
    "acceleration": lambda world, points: _first(points, accelerations=(0.0, -1.01 * world.growth, 0.0)),
    "NaN": lambda _world, points: (
        JOINTS,
        [*points[:-1], replace(points[-1], positions=(math.nan, 0.0, 0.0))],
    ),
    "infinite": lambda _world, points: _first(points, positions=(math.inf, 0.0, 0.0)),
    "names": lambda _world, points: (JOINTS[:2], points),
    "unknown": lambda _world, points: ((*JOINTS[:2], "gripper"), points),
    "twice": lambda _world, points: (
        (*JOINTS[:2], JOINTS[0]),
        [Point(one.at, (*one.positions[:2], one.positions[0])) for one in points],
    ),
    "backwards": lambda _world, points: (JOINTS, [*points, points[-1]]),
    "minus": lambda _world, points: _first(points, at=-0.5),
    "short": lambda _world, points: _first(points, positions=points[0].positions[:2]),
    "long velocities": lambda _world, points: _first(points, velocities=(0.0,) * 4),
    "long accelerations": lambda _world, points: _first(points, accelerations=(0.0,) * 4),
    "no names": lambda _world, points: ((), points),
}
"""Wrong trajectories, made of a good one."""

HONEST: Mapping[str, Callable[["JointsWorld"], Sends]] = {
    "plans": plans, "servo": servo, "sliders": sliders, "dense": dense, "partial": partial, "queued": queued,
    "cancelling": cancelling, "blend": blend,
}  # fmt: skip
NOT_PROMISED = {"blend"}
"""Honest senders whose trajectories `joints` may stop: it knows no velocity for certain while the arm moves."""
ACTS: Mapping[str, Callable[["JointsWorld"], float | None]] = {
    "past": past, "future": future, "elsewhere": elsewhere, "preempt": preempt, "edge": edge, "wild": wild,
    "halves": halves, "refused": refused, "replay": replay, "cancelled": cancelled, "wrong": wrong,
}  # fmt: skip
SENDERS: Mapping[str, Callable[["JointsWorld"], Sends]] = {
    **HONEST,
    **{name: beside(act) for name, act in {**ACTS, "mix": mix}.items()},
    "damage": damage,
    "stream": stream,
    "unstopped": unstopped,
}
UNSTAMPED = {"servo", "sliders", "stream"}
"""Senders none of whose trajectories has a stamp."""
PARTIAL = {"partial", "halves"}
KINDS: Sequence[str] = sorted(SENDERS)
