"""Worlds with a base that moves: among obstacles and persons (`separation`), and inside a fence (`fence`)."""

import copy
import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from lab.closed_loop import geometry
from lab.closed_loop.bases import DIFFERENTIAL, OMNIDIRECTIONAL, STEERED, Base
from lab.closed_loop.geometry import Point, Segment
from lab.closed_loop.messages import (
    ACKERMANN,
    ACKERMANN_STAMPED,
    FIX,
    ODOMETRY,
    POSE,
    POSE_WITH_COVARIANCE,
    SCAN,
    STILL,
    TWIST,
    TWIST_STAMPED,
    Legs,
    position,
    scan,
    travels,
)
from lab.closed_loop.world import SLACK, BrokenLawError, Report, World, void
from tests.support.features.guards.running_guard import Value

PERSON_RADIUS = 0.2
KINDS = {
    DIFFERENTIAL: (TWIST, TWIST, TWIST_STAMPED),
    OMNIDIRECTIONAL: (TWIST, TWIST_STAMPED),
    STEERED: (ACKERMANN, ACKERMANN_STAMPED),
}


class DrivenWorld(World):
    """A base, and a node that drives it somewhere at any rate, with pauses."""

    base: Base
    one_source: ClassVar[Mapping[str, tuple[str, ...]]] = {"by": ("dead", "cut")}
    heard = -1
    """When the last valid measurement arrived, or -1."""
    blind_from: int | None = None
    """When the first measurement without any evidence arrived that no valid one has followed."""
    legs: Legs
    escaped = False
    """Whether the base drove without the guard, so that no stop prevents the harm, and has not stood since."""
    each_counts = False
    """Whether persons also count who stepped in from beside, so near that no moving base can stop."""

    def build(
        self, kinds: "tuple[str, ...]", lag: int, braking: float, top: float, *, tight: bool = False
    ) -> None:
        r = self.random
        kind = r.choice(kinds)
        self.kind = r.choice(KINDS[kind])
        if tight:
            self.base = Base(kind, lag, braking, 10 * braking, top)
            return
        self.base = Base(kind, lag, braking * r.choice((1, 1, 1.3)), braking * r.choice((1, 2, 10)), top)
        self.base.heading = r.uniform(-math.pi, math.pi)
        self.base.wheelbase = r.choice((0.25, 0.4, 1.0))
        self.base.turn_gathering = r.choice((math.inf, 2.0, 0.7) if kind == STEERED else (math.inf, 6.0, 2.0))

    def drive_to(self, towards: "tuple[Point, ...]", *, turns: bool = True, forward: bool = False) -> None:
        """Let a node drive towards places, or anywhere, at 1 to 50 Hz, with pauses of up to 2 s."""
        r = self.random
        period = r.choice((20, 50, 100, 200, 500, 1000))
        self.legs = STILL
        self.until = 0.0

        def choose() -> None:
            speed = r.choice(
                (0.1, 0.3, 0.6, 1.0, self.base.top, self.base.top, 9.0, 1e300, math.inf, math.nan)
            )
            turning = r.choice((0.0, 0.0, 0.3, -0.3, 1.0, -1.5)) if turns else 0.0
            if towards and r.random() < 0.7:
                x, y = r.choice(towards)
                angle = math.atan2(y - self.base.y, x - self.base.x) - self.base.heading
            else:
                angle = r.uniform(-math.pi, math.pi)
            if self.base.kind == OMNIDIRECTIONAL and math.isfinite(speed):
                self.legs = (speed * math.cos(angle), speed * math.sin(angle), 0.0, 0.0, 0.0, turning)
            elif self.base.kind == OMNIDIRECTIONAL:
                self.legs = (speed, r.choice((0.0, speed, 1.0)), 0.0, 0.0, 0.0, turning)
            else:
                back = -1.0 if math.cos(angle) < 0 and not forward else 1.0
                self.legs = (back * speed, 0.0, 0.0, 0.0, 0.0, turning)
            self.until = self.now + r.uniform(200, 2500)

        def send() -> None:
            if self.now >= self.until:
                choose()
            self.drive(self.legs)

        self.every(
            lambda: period if r.random() > 0.01 else r.uniform(500, 2000), send, first=r.uniform(0, 300)
        )

    def received(self, at: int, legs: Legs) -> None:
        super().received(at, legs)
        self.base.order(at, legs)

    def move(self, until: int) -> None:
        self.base.move(until)

    def law(self, otherwise: str = "L2") -> str:
        return "L4" if self.foreign else "L2" if self.fault else otherwise

    def is_motion(self, legs: Legs) -> bool:
        return travels(legs)

    def source_of(self, topic: str) -> int:
        return 5

    def begins_again(self) -> None:
        super().begins_again()
        self.heard, self.blind_from = -1, None

    def switch(self) -> None:
        super().switch()
        self.escaped = True

    def enable_guard(self) -> None:
        super().enable_guard()
        self.escaped = self._harmed_though_stopped()

    def _caught(self) -> bool:
        """Return whether the base stands, and executes no command from before the guard was enabled."""
        executed = self.now > self.fresh_from + 100 + SLACK + self.base.lag
        return not self.switched_off and executed and math.hypot(*self.base.velocity) <= 0.01

    def harm(self) -> None:
        """Check that the base collides with nothing, or stays inside."""
        raise NotImplementedError

    def _harmed_though_stopped(self) -> bool:
        """Return whether a stop that comes now is too late."""
        ghost = copy.deepcopy(
            self, {id(one): one for one in (self.guard, self.random, self._queue, self._trace)}
        )
        ghost.report, ghost.escaped, ghost.each_counts = Report(), False, True
        ghost.base.order(self.now + SLACK, STILL)
        try:
            while (
                ghost.now < self.now + max(200, self.base.lag + 2 * SLACK)
                or math.hypot(*ghost.base.velocity) > 0
            ):
                ghost.move(ghost.now + 10)
                ghost.now += 10
                ghost.harm()
        except BrokenLawError:
            self.trace("the base drove without the guard, and now no stop prevents the harm")
            return True
        return False

    def note_arrival(self, *, valid: "bool | None") -> None:
        """Note the arrival of a measurement: valid, valid in parts (None), or without any evidence."""
        if valid or valid is None:
            self.heard, self.blind_from = self.now, None
        elif self.blind_from is None:
            self.blind_from = self.now

    def evidence(self, silent: float) -> None:
        """Check that nothing moves without evidence."""
        if not travels(self.force[1]) or self.switched_off or self.now <= self.fresh_from + 100 + SLACK:
            return
        if self.heard < 0:
            self.breach(self.law(), "a motion is in force before the first measurement")
        if self.blind_from is not None and self.now > self.blind_from + self.tick + SLACK:
            self.breach(
                self.law(),
                f"a motion is in force, though all measurements since {self.blind_from} ms are invalid",
            )
        if self.now > self.heard + silent * 1000 + self.tick + SLACK:
            self.breach(
                self.law(), f"a motion is in force, though the last measurement came at {self.heard} ms"
            )


@dataclass
class Person:
    x: float
    y: float
    speed: float
    begins: int
    leaves: float = math.inf
    """When the person turns back, in ms."""
    places: list[Point] = field(default_factory=list)
    """The place at each step of the world, the last one first."""
    stepped_in: bool = False
    """Whether the person came from beside the base's way, nearer than the separation distance."""


WHOLE, HALF = 3.2, 1.6
SCAN_FAULTS = (
    "dead", "NaN", "zero", "too near", "sector", "one infinite", "no range", "cut", "bag", "empty", "no step", "minus",
)  # fmt: skip


BLANK_FAULTS = {"NaN", "zero", "one infinite", "bag"}
"""Faults of a scanner whose blank readings mean that nothing is there."""


class SeparationWorld(DrivenWorld):
    """Walls and persons around a base with a scanner: ISO 13855 and ISO/TS 15066, speed and separation."""

    preset: ClassVar[str] = "separation"
    returns = False
    """Whether a scanner that was silent may send again."""
    tight_cases: ClassVar[tuple[str, ...]] = ("person", "slowing", "turn", "edge")

    def plan(self) -> None:
        r = self.random
        self.walls: list[Segment] = []
        self.persons: list[Person] = []
        self.fault = ""
        if self.case:
            self._plan_tight()
            return
        self.live = not self.alone and r.random() < 0.12
        if self.live:
            self._plan_honest()
            return
        self.sector = r.choice((WHOLE, WHOLE, WHOLE, HALF))
        self.unseen = r.choice((0.0, 0.2)) if self.sector == HALF else 0.0
        self.blank = r.choice((0.0, math.nan)) if r.random() < 0.2 else None
        self.speed = r.choice((0.0, 1.6, 1.6))
        braking, reaction = round(r.uniform(0.4, 3), 2), round(r.uniform(0.1, 0.5), 2)
        margin, self.silent = round(r.uniform(0.3, 0.6), 2), round(r.uniform(0.15, 0.8), 2)
        lag = r.randrange(10, int(reaction * 1000) - 20)
        self.build(
            (DIFFERENTIAL,) if self.sector == HALF else (DIFFERENTIAL, OMNIDIRECTIONAL, OMNIDIRECTIONAL, STEERED),
            lag, braking, r.choice((0.5, 1.0, 2.0, 3.0)),
        )  # fmt: skip
        self.reaction, self.braking, self.margin = reaction, braking, margin
        self.radius = margin - r.uniform(0.06, 0.15)
        mounted = round(r.uniform(-math.pi, math.pi) if self.sector == WHOLE else r.uniform(-0.4, 0.4), 2)
        self.shape(mounted)
        self._surroundings()
        self.guard_with({
            "sector": self.sector, "reaction": reaction, "braking": braking, "person": self.speed, "margin": margin,
            "silent": self.silent, "width": round(self.radius + r.uniform(0.06, 0.2), 2),
            "wheelbase": self.base.wheelbase, "mounted": mounted, "unseen": self.unseen,
            "blankIsFree": self.blank is not None,
        }, {"by": SCAN})  # fmt: skip
        self.scanner(r.uniform(25, self.silent * 850), r.uniform(0, reaction * 1000 - lag))
        self.drive_to(
            tuple((person.x, person.y) for person in self.persons) + tuple((w[0], w[1]) for w in self.walls),
            turns=self.sector == WHOLE,
        )  # fmt: skip
        if r.random() < 0.5:
            self.after(r.uniform(300, 6000), self._fail)
        self.with_second()
        self.interrupt()

    def shape(self, mounted: float) -> None:
        """Give the base an outline in some worlds, and the sensor a place and a direction on it.

        `radius` is the distance of the farthest corner from the sensor.
        """
        r = self.random
        self.base.sensor = (0.0, 0.0, mounted)
        if r.random() < 0.5:
            return
        angle = r.uniform(0.4, 1.2)
        length, width = self.radius * math.cos(angle), self.radius * math.sin(angle)
        low, high = -length * r.choice((1.0, r.uniform(0.2, 1))), length
        right, left = -width * r.choice((1.0, r.uniform(0.2, 1))), width
        x, y = r.uniform(low, high) * 0.8, r.uniform(right, left) * 0.8
        self.base.sensor = (-x, -y, mounted)
        corners = ((low, right), (high, right), (high, left), (low, left))
        self.base.outline = tuple((px - x, py - y) for px, py in corners)

    def gap(self, segment: Segment, radius: float = 0.0) -> float:
        """Return the metres between the base and a wall, or a disc; at most, if it is far from the base."""
        x, y, _turned = self.base.seen_from
        away = math.dist((x, y), geometry.nearest_on(segment, x, y)) - self.radius - radius
        if away > 0.02 or not self.base.outline:
            return away
        corners = [self.base.to_world(*corner) for corner in self.base.outline]
        if geometry.is_inside(corners, *segment[:2]):
            return -radius
        return min(geometry.apart(edge, segment) for edge in geometry.edges(corners)) - radius

    def good(self, topic: str) -> bytes:
        return scan(self.now, -math.pi, math.pi / 50, self.near, self.far, np.full(101, self.far * 0.9))

    def _surroundings(self) -> None:
        r = self.random
        for _wall in range(r.choice((1, 2, 4))):
            away, angle = r.uniform(self.radius + 0.3, 4), r.uniform(-math.pi, math.pi)
            if self.sector == HALF:
                angle = self.base.heading + r.uniform(-0.7, 0.7)
            cos, sin = math.cos(angle), math.sin(angle)
            x, y, length = away * cos, away * sin, r.choice((0.5, 10))
            self.walls.append((x - length * sin, y + length * cos, x + length * sin, y - length * cos))
        for _person in range(r.choice((0, 1, 2)) if self.speed and self.sector == WHOLE else 0):
            away, angle = r.uniform(self.radius + 0.5, 8), r.uniform(-math.pi, math.pi)
            self.persons.append(
                Person(
                    away * math.cos(angle),
                    away * math.sin(angle),
                    r.choice((0.5, 1.6, 1.6)),
                    r.randrange(4000),
                )
            )

    def _plan_honest(self) -> None:
        """Plan a corridor of 1.5 m, or 3 m straight in a room, with the preset's values but the person's."""
        r = self.random
        self.sector, self.silent, self.radius, self.speed = WHOLE, 0.5, 0.2, r.choice((0.0, 1.6))
        self.unseen, self.blank = 0.0, None
        self.build((DIFFERENTIAL,), 100, 1.0, 1.0)
        self.base.heading = 0.0
        corridor = r.random() < 0.5
        if corridor:
            self.walls = [(-20, 0.75, 20, 0.75), (-20, -0.75, 20, -0.75)]
        else:
            self.walls = geometry.edges([(-3, -4), (8, -4), (8, 4), (-3, 4)])
        self.honest = (0.3, 1.8) if corridor else (0.5, 3.0)
        self.span = 8000 if corridor else 9000
        self.guard_with({"sector": self.sector, "person": self.speed, "silent": self.silent}, {"by": SCAN})
        self.scanner(100, 20)
        self.every(
            lambda: 100, lambda: void(self.drive((self.honest[0], 0.0, 0.0, 0.0, 0.0, 0.0))), first=300
        )

    def _plan_tight(self) -> None:
        """Plan a base that is as slow as it declares, with an outline 1 cm within `margin`, that drives straight on.

        It drives at a person who walks at it, and the scanner dies as late as it may; or at one with scans that come
        after one interval and one and a half, where no tick may stop it; or along an arc at a pillar; or past an edge.
        """
        r = self.random
        self.live, self.unseen, self.blank, self.sector = False, 0.0, None, WHOLE
        self.speed = 1.6 if self.case in {"person", "slowing"} else 0.0
        self.reaction, self.braking = round(r.uniform(0.2, 0.4), 2), round(r.uniform(0.6, 1.2), 2)
        self.margin, self.silent, top = round(r.uniform(0.3, 0.5), 2), 0.9, r.uniform(0.8, 1.1)
        self.radius, delay = self.margin - 0.01, r.uniform(20, 80)
        self.build((DIFFERENTIAL,), int(self.reaction * 1000 - delay), self.braking, top, tight=True)
        turning = r.choice((-1, 1)) * r.uniform(0.7, 0.9) if self.case == "turn" else 0.0
        match self.case:
            case "person" | "slowing":
                self.persons = [Person(14.0, 0.0, 1.6, 0)]
            case "turn":
                angle, arc = r.uniform(1.8, 2.4), top / turning
                x, y = abs(arc) * math.sin(angle), arc * (1 - math.cos(angle))
                self.walls = [(x - 0.1, y, x + 0.1, y)]
            case _:
                self.walls = [(5.0, self.radius - 0.03, 5.0, 5.0)]
        self.guard_with({
            "reaction": self.reaction, "braking": self.braking, "person": self.speed, "margin": self.margin,
            "silent": self.silent, "width": round(self.radius + 0.01, 2),
        }, {"by": SCAN})  # fmt: skip
        intervals = itertools.cycle(
            (100.0, 100.0, 145.0, 60.0, 104.0) if self.case == "slowing" else (100.0,)
        )
        self.scanner(0.0, delay, lambda: next(intervals))
        self.far, self.angles = 30.0, np.linspace(-math.pi, math.pi, 361)  # a ray goes straight on
        self.legs = (top, 0.0, 0.0, 0.0, 0.0, turning)
        again = 400 if self.case == "turn" else 60_000
        self.every(lambda: again, lambda: void(self.drive(self.legs)), first=1000)

    def _left_for_age(self) -> float:
        """Return the metres that are left for the age of a scan that is made now."""
        speed = math.hypot(*self.base.velocity)
        delay = self.reaction + 0.02
        stops = speed * delay + speed**2 / (2 * self.braking) + self.speed * (delay + speed / self.braking)
        return self.gap((*[self.persons[0].x, self.persons[0].y] * 2,), PERSON_RADIUS) - stops - 0.01  # type: ignore[arg-type]  # four of them

    def receive(self, at: int, topic: str, data: bytes) -> None:
        if self.case == "slowing" and travels(self.force[1]):
            self.breach("live", "a base that is slowed is stopped between two scans")
        super().receive(at, topic, data)

    def scanner(self, period: float, delay: float, exact: "Callable[[], float] | None" = None) -> None:
        """Let a scanner look after `period` ms at most, or after `exact` ones with the whole of its delay."""
        r = self.random
        self.motions: list[int] = []
        """When the base got each motion."""
        self.looks: list[tuple[int, int]] = []
        """When each scan arrived, and when it was made."""
        count = r.choice((120, 240, 360))
        self.far = r.choice((3.0, 8.0, 30.0)) if not self.live else 12.0
        self.near = 0.05
        reach = math.pi if self.sector == WHOLE else 1.7
        self.angles = np.linspace(-reach, reach, count)
        arrived = 0.0

        def look() -> None:
            nonlocal arrived
            if self.fault == "dead":
                return
            discs = [(person.x, person.y, PERSON_RADIUS) for person in self.persons]
            x, y, turned = self.base.seen_from
            found = geometry.ranges(x, y, self.angles + turned, self.walls, discs)
            found[found > self.far] = np.inf
            found[found < self.near] = self.near
            data, valid = self.scan(found)
            arrived = max(arrived, self.now + (delay if exact else r.uniform(delay * 0.3, delay)))
            whole = self.fault != "cut"
            made = self.now
            if self.case == "person" and self._left_for_age() < 0.7 * self.silent * (
                self.base.vx + self.speed
            ):
                self.fault = "dead"
            self.after(arrived, lambda: self._arrive(made, data, valid, whole=whole))

        self.every(exact or (lambda: period * r.uniform(0.7, 1.0)), look, first=r.uniform(0, 200))

    def _arrive(self, made: int, data: bytes, valid: "bool | None", *, whole: bool) -> None:
        self.looks.append((self.now, made))
        self.arrive(data, valid, whole=whole)
        if self.case == "slowing" and self.now > 1000:
            self.drive(self.legs)

    def arrive(self, data: bytes, valid: "bool | None", *, whole: bool) -> None:
        self.say("by", data, 5, whole=whole)
        self.note_arrival(valid=valid)

    def _fail(self) -> None:
        faults = SCAN_FAULTS if self.blank is None else set(SCAN_FAULTS) - BLANK_FAULTS
        self.fault = self.random.choice(sorted(faults))
        self.trace(f"the scanner fails: {self.fault}")
        if (self.returns or self.fault != "dead") and self.random.random() < 0.5:
            self.after(self.now + self.random.uniform(500, 3000), self._repair)

    def _repair(self) -> None:
        self.trace("the scanner works again")
        self.fault = ""

    def scan(self, found: "np.ndarray") -> "tuple[bytes, bool | None]":
        """Return a scan with the present fault, and whether it is valid; None: parts of it are."""
        if self.blank is not None:
            found[found > self.far] = self.blank
        start, step = float(self.angles[0]), float(self.angles[1] - self.angles[0])
        low, high, valid = self.near, self.far, not self.fault
        match self.fault:
            case "NaN":
                found = np.full_like(found, np.nan)
            case "zero":
                found = np.zeros_like(found)
            case "minus":
                found = np.full_like(found, -np.inf)
            case "too near":
                low, found = 0.2, np.full_like(found, 0.19)
            case "sector":
                start, step = math.pi - 0.3, 0.6 / len(found)
            case "one infinite":
                found = np.full_like(found, np.nan)
                found[self.random.randrange(len(found))] = np.inf
            case "no range":
                low, high = 0.0, self.random.choice((0.0, math.inf))
                found = np.full_like(found, high)
            case "empty":
                found = found[:0]
            case "no step":
                step = self.random.choice((0.0, math.nan))
            case "bag":
                front = self.random.choice((0, len(found) // 3, len(found) // 2))
                found[front : front + len(found) // 3] = self.random.choice((np.nan, 0.0))
                return scan(self.now, start, step, low, high, found), None
        data = scan(self.now, start, step, low, high, found)
        return (data[: len(data) // 2] if self.fault == "cut" else data), valid

    def move(self, until: int) -> None:
        seconds = (until - self.base.now) / 1000
        self.base.move(until)
        for one in self.persons:
            away = math.dist((one.x, one.y), (self.base.x, self.base.y))
            if until > one.leaves and away > 0:
                one.x -= (self.base.x - one.x) / away * one.speed * seconds
                one.y -= (self.base.y - one.y) / away * one.speed * seconds
            elif until > one.begins and (left := self.gap((one.x, one.y, one.x, one.y), PERSON_RADIUS)) > 0:
                way = min(one.speed * seconds, left)
                one.x += (self.base.x - one.x) / away * way
                one.y += (self.base.y - one.y) / away * way

    def evidence(self, silent: float) -> None:
        if not self.force[1][0] < 0 < self.unseen:
            super().evidence(silent)

    def watch(self) -> None:
        self.harm()
        self.evidence(self.silent)
        self.only_fresh()

    def harm(self) -> None:
        for person in self.persons:
            self._follow(person)
        self.escaped = self.escaped and not self._caught()
        things = [(wall, 0.0) for wall in self.walls]
        things += [
            ((one.x, one.y, one.x, one.y), PERSON_RADIUS)
            for one in self.persons
            if self.each_counts or not one.stepped_in
        ]
        vx, vy = self.base.velocity
        if self.escaped or self.base.vx < 0 < self.unseen:
            return
        for thing, radius in things:
            x, y = geometry.nearest_on(thing, self.base.x, self.base.y)
            dx, dy = x - self.base.x, y - self.base.y
            away = math.hypot(dx, dy)
            towards = (vx * dx + vy * dy) / away if away > 0 else math.hypot(vx, vy)
            if towards <= 0.01:
                continue
            left = self.gap(thing, radius)
            self.report.clearance = min(self.report.clearance, left)
            if left <= 1e-9:
                what = "a person" if radius else "a wall"
                law = self.law("L1" if self.base.kind == OMNIDIRECTIONAL and self.force[1][1] else "L3")
                self.breach(law, f"the base touches {what} at {towards:.2f} m/s")

    def _follow(self, person: Person) -> None:
        """Note whether a person has stepped into the base's way from beside it, so near that no moving base can stop.

        The place counts that the person had at the last look before the motion passed that the base executes.
        """
        person.places = [(person.x, person.y), *person.places[:300]]
        is_in = self._in_way(person.x, person.y)
        steps = (self.now - self._looked()) // 10
        before = person.places[min(max(steps, 1), len(person.places) - 1)]
        if not is_in:
            person.stepped_in = False
        elif not person.stepped_in and not self._in_way(*before):
            speed = math.hypot(*self.base.velocity)
            delay = self.reaction + self.silent
            needed = (
                (self.speed + speed) * delay
                + self.speed * speed / self.braking
                + speed**2 / (2 * self.braking)
            )
            away = math.dist((person.x, person.y), (self.base.x, self.base.y)) - PERSON_RADIUS
            person.stepped_in = away < needed + self.margin

    def passed(self, node: int, wanted: Legs, got: "Legs | None") -> None:
        if self.sector == HALF and got is not None and got[0] < -self.unseen * (1 + 1e-6):
            self.breach("L2", f"{got[0]:.3f} m/s pass out of the sector; {self.unseen} is permitted")

    def _looked(self) -> int:
        """Return when the scanner looked last before the motion passed that the base executes."""
        passed = next((at for at in reversed(self.motions) if at + self.base.lag <= self.now), self.now)
        return next((seen for arrived, seen in reversed(self.looks) if arrived <= passed), self.now)

    def received(self, at: int, legs: Legs) -> None:
        super().received(at, legs)
        if travels(legs):
            self.motions.append(at)

    def _in_way(self, x: float, y: float) -> bool:
        vx, vy = self.base.velocity
        speed = math.hypot(vx, vy)
        dx, dy = x - self.base.x, y - self.base.y
        return (
            speed > 0.01
            and vx * dx + vy * dy > 0
            and abs(vx * dy - vy * dx) / speed < self.radius + PERSON_RADIUS
        )

    def ended(self) -> None:
        if self.live and self.base.driven < 0.6 * self.honest[1]:
            self.breach(
                "live", f"the base drives {self.base.driven:.2f} m, not {self.honest[1]} m, in {self.span} ms"
            )


FIELDS: tuple[tuple[Point, ...], ...] = (
    ((-2, -2), (2, -2), (2, 2), (-2, 2)),
    ((-2, -2), (-2, 2), (2, 2), (2, -2)),
    ((-3, -1), (3, -1), (3, 1), (-3, 1)),
    ((-2, -2), (3, -2), (0, 3)),
    ((-3, -3), (3, -3), (3, 0), (0.5, 0), (0.5, 3), (-3, 3)),
    ((-3, -2), (0, -1), (3, -2), (2, 2), (0, 1), (-2, 2)),
)
POSITION_FAULTS = ("dead", "NaN", "no heading", "infinite heading", "cut", "gap")


class FenceWorld(DrivenWorld):
    """A base inside a polygon, or at first outside: not a centimetre is left outside."""

    preset: ClassVar[str] = "fence"
    tick = 50
    tight_cases: ClassVar[tuple[str, ...]] = ("straight", "late", "slowing")
    judged_at = -1
    """When the guard judged the last position."""

    def plan(self) -> None:
        r = self.random
        self.fault, self.live = "", not self.alone and r.random() < 0.1
        self.field: tuple[tuple[float, float], ...] = FIELDS[0] if self.live else r.choice(FIELDS)
        self.margin, ahead, self.silent = 0.2, 0.5, 0.5
        if self.case:
            self._plan_tight()
            return
        if not self.live:
            self.margin, ahead = round(r.uniform(0.1, 0.4), 2), round(r.uniform(0.3, 1), 2)
            self.silent = round(r.uniform(0.1, 1), 2)
        delay, lag = r.uniform(0, ahead * 200), r.randrange(10, int(ahead * 300))
        braking = r.uniform(0.5, 4)
        self.by = r.choice((ODOMETRY, ODOMETRY, POSE, POSE_WITH_COVARIANCE, FIX))
        self.world_frame = self.by == FIX
        self.build((DIFFERENTIAL, STEERED) if self.live and not self.world_frame else (OMNIDIRECTIONAL,)
                   if self.world_frame else (DIFFERENTIAL, OMNIDIRECTIONAL, STEERED), lag, braking,
                   (ahead * 0.98 - (lag + delay) / 1000) * braking)  # fmt: skip
        self.noise = 0.0 if self.live else self.margin * r.choice((0, 0, 0.4))
        self.outside = not self.live and r.random() < 0.15
        self._place()
        self.least = min(0.0, self._depth())
        corners = " ".join(f"{x},{y}" for x, y in self.field)
        self.inward = r.choice((0.1, 0.3))
        self.origin = r.choice(((0.0, 0.0), (52.5, 13.4), (-77.85, -179.99998)))
        values: dict[str, Value] = {
            "margin": self.margin, "ahead": ahead, "silent": self.silent, "polygon": corners, "inward": self.inward,
            "worldFrame": self.world_frame, "wheelbase": self.base.wheelbase, "lat0": self.origin[0],
            "lon0": self.origin[1],
        }  # fmt: skip
        self.guard_with(values, {"by": self.by})
        self._positions(r.uniform(20, self.silent * (200 if self.live else 900)), delay)
        if self.live:
            self.base.heading = 0.0
            speed = min(0.3, self.base.top)
            self.honest = min(1.2, speed * 4)
            self.every(lambda: 100, lambda: void(self.drive((speed, 0.0, 0.0, 0.0, 0.0, 0.0))), first=700)
            return
        self.drive_to(self.field, turns=not self.outside)
        if r.random() < 0.4:
            self.after(r.uniform(300, 6000), self._fail)
        self.with_second()
        self.interrupt()

    def _plan_tight(self) -> None:
        """Plan a base that needs all of `ahead` to stop, and drives straight over the edge.

        The positions end as late as they may; or they come after one interval and one and a half, where no tick may
        stop the base.
        """
        r = self.random
        self.live, self.by, self.world_frame, self.noise, self.outside = False, ODOMETRY, False, 0.0, False
        self.field = ((-8, -8), (8, -8), (8, 8), (-8, 8))
        self.least, self.origin, self.inward = 0.0, (0.0, 0.0), 0.3
        self.margin, self.silent, self.ahead = 0.01, 0.9, round(r.uniform(0.5, 0.9), 2)
        delay, lag, braking = r.uniform(20, 60), r.randrange(50, 150), r.uniform(1.5, 3)
        top = (self.ahead - (delay + lag) / 1000) * 2 * braking
        self.build((DIFFERENTIAL,), lag, braking, min(top, 2.0), tight=True)
        self.base.braking = self.base.full_braking = self.base.top / 2 / (self.ahead - (delay + lag) / 1000)
        corners = " ".join(f"{x},{y}" for x, y in self.field)
        self.guard_with(
            {"margin": self.margin, "ahead": self.ahead, "silent": self.silent, "polygon": corners},
            {"by": ODOMETRY},
        )
        pattern = {"straight": (20.0,), "late": (100.0,)}.get(self.case, (100.0, 100.0, 145.0, 60.0, 104.0))
        intervals = itertools.cycle(pattern)
        self._positions(0.0, delay, lambda: next(intervals))
        self.legs = (self.base.top, 0.0, 0.0, 0.0, 0.0, 0.0)
        self.after(500, lambda: void(self.drive(self.legs)))

    def receive(self, at: int, topic: str, data: bytes) -> None:
        if self.case == "slowing" and travels(self.force[1]) and self.now > self.judged_at:
            self.breach("live", "a base that is slowed is stopped between two positions")
        super().receive(at, topic, data)

    def good(self, topic: str) -> bytes:
        return position(self.by, self.now, -1.0, 0.0, 0.0, origin=self.origin)

    def _place(self) -> None:
        r = self.random
        if self.live:
            return
        while True:
            self.base.x, self.base.y = r.uniform(-4, 4), r.uniform(-4, 4)
            left = self._depth()
            if -1 < left < -0.2 if self.outside else left > self.margin + 0.05:
                return

    def _depth(self) -> float:
        return geometry.depth(self.field, self.base.x, self.base.y)

    def _positions(self, period: float, delay: float, exact: "Callable[[], float] | None" = None) -> None:
        r = self.random
        arrived = 0.0

        def look() -> None:
            nonlocal arrived
            if self.fault in {"dead", "gap"}:
                return
            x, y, quaternion = self.base.x, self.base.y, (0.0, 0.0, 0.0, 0.0)
            angle = r.uniform(-math.pi, math.pi)
            x, y = x + self.noise * math.cos(angle), y + self.noise * math.sin(angle)
            known: tuple[float, ...] = ()
            match self.fault:
                case "NaN":
                    x, y = r.choice(((math.nan, y), (x, math.nan), (math.inf, y)))
                case "no heading":
                    known = quaternion
                case "infinite heading":
                    known = r.choice(
                        ((1e200, 1e200, 1e200, 1e200), (0.0, 0.0, math.nan, 1.0), (0.0, 0.0, 0.0, math.inf))
                    )
            data = position(self.by, self.now, x, y, self.base.heading, known, self.origin)
            data = data[:20] if self.fault == "cut" else data
            valid = (
                None if self.fault.endswith("heading") else not self.fault
            )  # far from the edge it needs none
            arrived = max(arrived, self.now + (delay if exact else r.uniform(delay * 0.3, delay)))
            whole = self.fault != "cut"
            if self.case in {"straight", "late"}:
                rest = self.silent + 0.04 if self.case == "straight" else 0.27
                ends = self._depth() - self.margin < self.base.vx * (rest + self.ahead)
                self.fault = "dead" if ends else ""
            self.after(arrived, lambda: self.arrive(data, valid, whole=whole))

        self.every(exact or (lambda: period * r.uniform(0.7, 1.0)), look, first=r.uniform(0, 200))

    def arrive(self, data: bytes, valid: "bool | None", *, whole: bool) -> None:
        self.judged_at = self.now
        self.say("by", data, 5, whole=whole)
        self.note_arrival(valid=valid)
        if self.case == "slowing" and self.now > 500:
            self.drive(self.legs)

    def _fail(self) -> None:
        self.fault = self.random.choice(POSITION_FAULTS)
        self.trace(f"the position fails: {self.fault}")
        if self.fault == "gap" or (self.fault != "dead" and self.random.random() < 0.5):
            self.after(self.now + self.random.uniform(500, 3000), self._repair)

    def _repair(self) -> None:
        self.trace("the position is right again")
        self.fault = ""

    def passed(self, node: int, wanted: Legs, got: "Legs | None") -> None:
        far = self.planned_act != "switch" and self._depth() < -self.noise - 0.1
        if far and got is not None and math.hypot(*got[:3]) > self.inward * (1 + 1e-6):
            self.breach("L3", f"{math.hypot(*got[:3]):.3f} m/s pass outside; {self.inward} is permitted")

    def received(self, at: int, legs: Legs) -> None:
        if self.world_frame:
            self.base.heading = 0.0
            legs = (*legs[:5], 0.0)
        super().received(at, legs)

    def watch(self) -> None:
        self.harm()
        self.evidence(self.silent)
        self.only_fresh()

    def harm(self) -> None:
        left = self._depth()
        speed = math.hypot(*self.base.velocity)
        if self.escaped:
            self.escaped = not self._caught()
            self.least = min(0.0, left)
            self.outside = left < 0
            return
        if not self.outside and speed > 0.01:
            self.report.clearance = min(self.report.clearance, left)
        if left > self.margin:
            self.least = 0.0
        if left < self.least - (0.01 if self.least < 0 else 1e-9):
            where = (
                f"{-left:.3f} m outside" if self.least == 0 else f"{self.least - left:.3f} m further outside"
            )
            self.breach(self.law("L3"), f"the base is {where}, at {speed:.2f} m/s")

    def ended(self) -> None:
        if self.live and self.base.driven < 0.6 * self.honest:
            self.breach("live", f"the base drives {self.base.driven:.2f} m, not {self.honest:.2f} m")
