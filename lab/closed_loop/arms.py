"""Worlds of `joints`: an arm that its controller moves (`controller.py`), and nodes that report where its joints are.

Beside the assumptions of `world.py`:

- The clocks of senders, controller and the nodes that report agree. The guard's clock differs from theirs by up to a
  quarter of an hour, unless reports have no stamps.
- A trajectory reaches the controller within 10 ms, and a report the guard within 20 ms; the controller runs every 10 ms
  or oftener, and the arm follows it exactly.
- Trajectories come only through the guard. A goal may also be cancelled beside it, which stops the arm. Bytes that are
  no report let the guard begin again, and with it a stop.
- A joint may gain at most one `jump` on 1.1 `vMax`, over any time, and what it moves in one update of the controller,
  of which the guard does not know. To enable the guard does not stop what passed while it was off.
- A stop takes the controller's `stop_trajectory_duration`, and adds its way: five eighths of the velocity times the
  duration.
"""

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

from lab.closed_loop.controller import Controller, Point, extremes
from lab.closed_loop.messages import EPOCH
from lab.closed_loop.senders import (
    HONEST,
    JOINTS,
    KINDS,
    NOT_PROMISED,
    OVERSHOOT,
    PARTIAL,
    SENDERS,
    UNSTAMPED,
    Sent,
    bare,
    line,
)
from lab.closed_loop.world import COMMAND, NEVER, SLACK, World

TRAJECTORY, GOAL = "trajectory_msgs/JointTrajectory", "control_msgs/FollowJointTrajectoryActionGoal"
_NEAR = 1e-5
_ROUNDING = 1e-9
"""Seconds."""
_STEP = 0.0025
"""Seconds between two looks at the arm, at most."""


def _texts(names: Sequence[str]) -> bytes:
    parts = [name.encode() for name in names]
    return struct.pack("<I", len(parts)) + b"".join(struct.pack("<I", len(part)) + part for part in parts)


def _numbers(values: Sequence[float]) -> bytes:
    return struct.pack(f"<I{len(values)}d", len(values), *values)


def _time(seconds: float) -> tuple[int, int]:
    return divmod(round(seconds * 1e9), 10**9)


def trajectory(sent: Sent, began: float, kind: str) -> bytes:
    """Return the message; the world has begun at this second."""
    seconds, rest = (0, 0) if sent.stamp is None else _time(began + sent.stamp)
    data = struct.pack("<4I", 0, seconds, rest, 0) + _texts(sent.names) + struct.pack("<I", len(sent.points))
    for point in sent.points:
        for values in (point.positions, point.velocities, point.accelerations, ()):
            data += _numbers(values)
        data += struct.pack("<ii", *_time(point.at))
    return data if kind == TRAJECTORY else bytes(16) + bytes(12) + data + bytes(16)


def states(
    stamp: float, names: Sequence[str], positions: Sequence[float], velocities: Sequence[float] = ()
) -> bytes:
    return (
        struct.pack("<4I", 0, *_time(stamp), 0)
        + _texts(names)
        + _numbers(positions)
        + _numbers(velocities)
        + _numbers(())
    )


class JointsWorld(World):
    """An honest sender alone, or a hostile or faulty one beside it: the seed's place in `KINDS` says which."""

    preset: ClassVar[str] = "joints"
    span = 8000
    one_source: ClassVar[Mapping[str, tuple[str, ...]]] = {"state": ("dead", "half dead")}
    not_yet: ClassVar[Mapping[str, str]] = {
        "switch beside a third node": "the first reporter keeps its place, and the next node gets the other place",
        "cut beside a third node": "as with *switch*",
    }

    def plan(self) -> None:
        r = self.random
        self.sender = KINDS[self.seed % len(KINDS)]
        self.live = not self.alone and self.sender in HONEST
        self.tight = not self.live and not self.alone and self.seed // len(KINDS) % 2 == 0
        """Whether no margin hides a missing term: no delays, a small jump, fresh reports, and nothing else happens."""
        self.fastest: float = round(r.uniform(0.5, 3), 2)
        self.most = round(r.uniform(1, 3), 2)
        self.jump = round(r.uniform(0.06 if self.live else 0.02, 0.2), 2)
        if self.tight:
            self.jump = 0.1 if self.sender == "stream" else 0.005  # a stream gains by it again and again
        self.silent = round(r.uniform(0.1, 0.6), 2)
        self.growth: float = r.choice((8.0, 20.0, 50.0))
        self.stopping = r.choice((0.2, 0.5) if self.sender == "unstopped" else (0.0, 0.0, 0.2, 0.5))
        self.controller = Controller(
            JOINTS, period=r.choice((0.001, 0.001 if self.tight else 0.01)), stopping=self.stopping,
            partial=self.sender in PARTIAL or (self.sender != "refused" and r.random() < 0.5),
        )  # fmt: skip
        self.delay = 0 if self.tight else r.choice((0, 2, 10))
        self.place = [0.0] * len(JOINTS)
        self.told = [0.0] * len(JOINTS)
        """Where the joints were, as the nodes have reported."""
        self.extra = [0.0] * len(JOINTS)
        """How far each joint has come beyond 1.1 `vMax`, as far as it has not yet waited for it."""
        self.rest = [0.0] * len(JOINTS)
        """How far each joint may still move since a stop, until its trajectory begins."""
        self.begins = [math.inf] * len(JOINTS)
        """When the trajectory of each joint begins: with an update of the controller, or later."""
        self.unknown = 0
        """How many of the next stops begin again, as the guard does not know of the last one, which was beside it."""
        self.loose = 0.0
        """When the last trajectory ends that passed while the guard was off; to enable the guard does not stop it."""
        self.ends = 0.0
        """When the last trajectory that was sent ends."""
        self.kept: list[Sent] = []
        self.heard: dict[int, int] = {}
        """When each node that has named joints since the guard began did so last with numbers."""
        self.fault = ""
        self.curved = r.choice(("", "velocities", "velocities and accelerations"))
        """The values of points beside their positions."""
        limits = " ".join(f"{name}:{-self.most}..{self.most}" for name in JOINTS) if r.random() < 0.5 else ""
        values = {"vMax": self.fastest, "aMax": self.growth, "jump": self.jump, "silent": self.silent}
        bounds = {"limits": limits} if limits else {"low": -self.most, "high": self.most}
        # Without a stamp, it makes no difference whose clock a stamp would be of.
        simulated = self.sender in UNSTAMPED and self.seed // len(KINDS) % 3 == 1
        declared = {"simulated": simulated, "stopDuration": self.stopping, "partial": self.controller.partial}
        self.kind = GOAL if r.random() < 0.25 and self.sender != "unstopped" else TRAJECTORY
        self.stamps = self.seed // len(KINDS) % 5 != 1
        """Whether reports have stamps."""
        self.began = EPOCH + (r.uniform(-900, 900) if self.stamps else 0)
        """The second in which the controller's time begins; that of the guard begins at `EPOCH`."""
        self.guard_with({**values, **bounds, **declared})
        halves = r.random() < (0.7 if self.alone else 0.4)
        self.reports = {3: JOINTS[:1], 4: JOINTS[1:]} if halves else {3: JOINTS}
        for node, names in self.reports.items():
            period = 10.0 if self.tight else r.uniform(10, 50 if self.live else self.silent * 800)
            late = 0.0 if self.tight else min(r.choice((0, 1, 5, 20)), self.silent * 100)
            velocities = r.random() < 0.5
            self.every(
                lambda period=period: period * (1 if self.tight else r.uniform(0.7, 1)),  # type: ignore[misc]  # bound now
                lambda node=node, names=names, late=late, velocities=velocities: self._read(  # type: ignore[misc]  # as above
                    node, names, late, velocities=velocities
                ),
                first=0 if self.tight else r.uniform(0, 200),
            )
        self.sends = SENDERS[self.sender](self)
        self.after(600, self._next)
        if not self.live and not self.tight:
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
        self.unknown = 2  # a stop of which it does not know, so the next one may prolong it

    def counts(self, topic: str) -> bool:
        return self.third  # two nodes may report, and both have to

    def stops_for(self, topic: str) -> float:
        return self.silent * 1000

    def good(self, topic: str) -> bytes:
        return states(self.stamp, JOINTS, self.place)

    def damages(self, topic: str) -> bool:
        return not self.third

    def _fails(self) -> None:
        self.fault = self.random.choice(
            ("dead", "half dead", "NaN", "no names", "dead" if self.third else "cut")
        )
        self.trace(f"the positions fail: {self.fault}")
        if self.random.random() < 0.5:
            self.after(self.now + self.random.uniform(300, 2000), lambda: setattr(self, "fault", ""))

    def _read(self, node: int, names: Sequence[str], late: float, *, velocities: bool) -> None:
        found = [self.controller.state(JOINTS.index(name), self.time) for name in names]
        numbers = [one[0] for one in found], [one[1] for one in found] if velocities else []
        stamp = self.stamp
        self.after(self.now + late, lambda: self._report(stamp, node, names, *numbers))

    @property
    def stamp(self) -> float:
        return self.began + self.time if self.stamps else 0.0

    def _report(
        self, stamp: float, node: int, names: Sequence[str], places: list[float], velocities: Sequence[float]
    ) -> None:
        match self.fault:
            case "dead":
                return
            case "half dead" if node == max(self.reports):
                return
            case "NaN":
                places = [math.nan] * len(places)
            case "no names" if node not in self.heard:
                self.say("state", states(stamp, (), places), node)  # a node that has named no joint owes none
                return
            case "no names":
                names = ()
            case "cut":
                self.heard[node] = NEVER
                self.unknown = 2
                self.say("state", states(stamp, names, places)[:20], node, whole=False)
                return
            case "":
                for name, place in zip(names, places, strict=True):
                    self.told[JOINTS.index(name)] = place
        self.heard[node] = self.now if self.fault in {"", "half dead"} else NEVER
        self.say("state", states(stamp, names, places, velocities if names else ()), node)

    # Commands

    def _next(self) -> None:
        pause = next(self.sends, None)
        if pause is not None:
            self.after(self.now + max(1, 1000 * pause), self._next)

    @property
    def time(self) -> float:
        return self.now / 1000

    @property
    def still(self) -> bool:
        """Whether the arm has stood for 0.1 s, and nothing is queued."""
        ends = (each.begin + each.seconds for way in self.controller.ways for each in way[-1:])
        return self.time > max(self.ends, *ends) + 0.1

    def route(
        self, scale: float, step: float, *, has: int, start: Sequence[float] = (), far: float = 0.9
    ) -> list[Point]:
        """Return a plan from where the arm is, as far as the nodes have told, to anywhere."""
        r = self.random
        for _try in range(20):
            goal = [r.uniform(-far, far) * self.most for _ in JOINTS]
            points = line(
                start or self.told,
                goal,
                scale * self.fastest,
                r.choice((0.1, 0.5)) * self.growth,
                step,
                smooth=r.random() < 0.5,
            )
            found = extremes(bare(points, has), 12)
            if len(points) < 60 and found[0] <= self.most and found[1] <= 1.08 * self.fastest:
                return bare(points, has)
        return [Point(1.0, tuple(start or self.told))]

    def send(self, sent: Sent, node: int | None = None, *, honest: bool = False) -> bool:
        shown = "" if sent.stamp is None else f", stamp {sent.stamp:.3f}"
        self.trace(f"a trajectory of {len(sent.points)} points{shown}: {sent.bad or self.sender}")
        if self.tight:
            for reporter, names in self.reports.items():
                self._report(
                    self.stamp, reporter, names, [self.place[JOINTS.index(name)] for name in names], ()
                )
        data = trajectory(sent, self.began, self.kind)
        topic = self.guard.topics[COMMAND]
        passed, messages = self.guard.tell(topic, data, self.now, node or self.commander)
        for message in messages:
            self.receive(*message)
        passes = passed == data
        self.trace("  it passes" if passes else "  it is stopped")
        if honest and self.live and self.sender not in NOT_PROMISED and self.now > 1000:
            self.report.honest["sent"] += 1
            self.report.honest["passed"] += passes
        self._judge(sent, passes=passes)
        if passed is not None:
            # An arm cannot follow what is not a number, and the controller would never leave it.
            driven = passes and (not sent.bad or (self.switched_off and sent.bad not in {"NaN", "infinite"}))
            self.receive(self.now, topic, passed, sent if driven else None)
            if passes and sent.points:
                begin = self.time if sent.stamp is None else max(self.time, sent.stamp)
                self.ends = begin + sent.points[-1].at if math.isfinite(sent.points[-1].at) else begin
                self.loose = max(self.loose, self.ends) if self.switched_off else self.loose
        return passes

    def cancel(self) -> None:
        """Stop the arm beside the guard, as a cancelled goal does."""
        self.trace("the goal is cancelled")
        self.unknown = 2
        self._stop()
        self.ends = self.time

    def walk(self) -> list[Point]:
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
        return self.bend(points, lambda far, fast: far <= 0.99 * self.most and fast <= 0.99 * self.fastest)

    def bend(self, points: list[Point], fits: Callable[[float, float], bool]) -> list[Point]:
        """Return the points with velocities such that the curves between them fit, or else as they are."""
        r = self.random
        for _try in range(20 if self.curved else 0):
            v, a = (r.choice((0.1, 0.5, 1.0)) * most for most in (self.fastest, self.growth))
            made = [
                replace(
                    point,
                    velocities=tuple(r.uniform(-v, v) for _ in JOINTS),
                    accelerations=tuple(r.uniform(-a, a) for _ in JOINTS) if "acc" in self.curved else (),
                )
                for point in points[1:]
            ]
            made = [points[0], *made]  # the way to the first point is straight
            if fits(*extremes(made)):
                return made
        return points

    def _judge(self, sent: Sent, *, passes: bool) -> None:
        if self.switched_off or not passes or not sent.points:
            return
        if self.holding or self.guard.holds:
            self.breach("L5", "a trajectory passes a guard that holds")
        if why := self.beside_source():
            self.breach("L4", f"a trajectory passes: {why}")
        law = {"NaN": "L2", "infinite": "L2", "jump": "L3"}.get(sent.bad, "L1")
        if sent.bad:
            self.breach(law, f"a trajectory passes that is wrong: {sent.bad}")
        may_answer = self.second is not None and not self.third
        for node in self.heard if may_answer else self.reports:
            asked = {*self.reports[node]} & {*sent.names}
            if asked and self.now > max(self.heard.get(node, NEVER) + self.silent * 1000, self.fresh_from):
                self.breach(
                    "L4" if self.foreign else "L2",
                    f"a trajectory passes, and node {node} does not report where the joints are",
                )

    # Motion

    def receive(self, at: int, topic: str, data: bytes, sent: Sent | None = None) -> None:
        """Take a trajectory; what the guard sends, also to the topic that cancels goals, stops the arm."""
        self.after(max(at, self.now) + self.delay, lambda: self._take(sent))

    def _take(self, sent: Sent | None) -> None:
        if sent is None or not sent.points:
            self._stop()
            return
        update = self.controller.last_update(self.time) + self.controller.period
        if not self.controller.take(self.time, sent.names, sent.stamp, sent.points):
            self.trace("the controller rejects it")
            return
        for joint in map(JOINTS.index, sent.names):
            self.begins[joint] = min(self.begins[joint], max(update, sent.stamp or 0))

    def _stop(self) -> None:
        # It begins at the last update of the controller, or the state before.
        times = self.time, self.controller.last_update(self.time)
        for joint, begin in enumerate(self.begins):
            begun = begin <= max(times) + _ROUNDING
            if self.unknown or begun:
                fastest = max(abs(self.controller.state(joint, time)[1]) for time in times)
                way = fastest * (0.625 * self.stopping + 2 * self.controller.period) + _NEAR
                self.rest[joint] = way if begun else max(way, self.rest[joint])
        self.begins = [math.inf] * len(JOINTS)
        self.unknown = max(0, self.unknown - 1)
        self.loose = min(self.loose, self.time)
        self.controller.stop(self.time)

    @property
    def unjudged(self) -> bool:
        return (
            self.switched_off
            or self.time < self.loose + self.stopping
            or self.now < self.fresh_from + 100 + SLACK + self.delay + 1000 * self.stopping
        )

    def move(self, until: int) -> None:
        begin, end = self.time, until / 1000
        if end <= begin:
            return
        number = math.ceil((end - begin) / _STEP)
        times = {end, *(begin + (end - begin) * step / number for step in range(1, number))}
        for joint, way in enumerate(self.controller.ways):
            last = way[-1]
            if last.begin + last.seconds < begin and last.state(end)[0] == self.place[joint]:
                self.extra[joint] = max(0.0, self.extra[joint] - OVERSHOOT * self.fastest * (end - begin))
                continue
            at = begin
            for time in sorted(times.union(*(one.looks(begin, end) for one in way))):
                self._watch_joint(joint, self.controller.state(joint, time)[0], time, time - at)
                at = time

    def _watch_joint(self, joint: int, place: float, time: float, passed: float) -> None:
        before, self.place[joint] = self.place[joint], place
        if self.unjudged:
            self.extra[joint] = 0.0
            return
        moved = abs(place - before)
        self.extra[joint] = max(0.0, self.extra[joint] + moved - OVERSHOOT * self.fastest * passed)
        if not self.extra[joint] <= self.jump + OVERSHOOT * self.fastest * self.controller.period + _NEAR:
            gained = f"{JOINTS[joint]} has gained {self.extra[joint]:.3f} rad on 1.1 vMax"
            self.breach("L3", f"{gained}, and a jump is {self.jump}")
        if time < self.begins[joint] - _ROUNDING:  # then its first point, if that is at 0 s, is a jump
            self.rest[joint] -= moved
            if not self.rest[joint] >= -_NEAR:
                self.breach("L3", f"{JOINTS[joint]} moves on after a stop by more than the way of a stop")
        elif not abs(place) <= self.most + _NEAR and abs(place) > abs(before):
            self.breach("L1", f"{JOINTS[joint]} is out of its limits: {place:.3f}")

    def ended(self) -> None:
        sent, passed = self.report.honest["sent"], self.report.honest["passed"]
        if passed < 0.9 * sent:
            self.breach("live", f"of {sent} honest trajectories {passed} pass")
