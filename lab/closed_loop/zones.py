"""Worlds of `zone`: a base with a square zone around it, which covers its way until it stands, or with any polygon."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

import numpy as np

from lab.closed_loop import geometry
from lab.closed_loop.bases import DIFFERENTIAL, OMNIDIRECTIONAL, STEERED
from lab.closed_loop.geometry import Point
from lab.closed_loop.messages import SCAN, STILL, Legs, boolean, straight
from lab.closed_loop.motion import PERSON_RADIUS, WHOLE, Person, SeparationWorld
from lab.closed_loop.world import NEVER, SLACK, void
from tests.support.features.guards.running_guard import Value

FRONT: Sequence[Point] = ((0.1, -0.4), (1, -0.4), (1, 0.4), (0.1, 0.4))

MUTED = 2.0
"""Seconds of the longest muting."""


class ZoneWorld(SeparationWorld):
    """Walls and persons around a base that stops, or slows, while something is in its zone."""

    preset: ClassVar[str] = "zone"
    returns = True
    tight_cases: ClassVar[tuple[str, ...]] = ()
    not_yet: ClassVar[Mapping[str, str]] = {}
    one_source: ClassVar[Mapping[str, tuple[str, ...]]] = {"by": ("dead", "cut"), "mute": ()}

    def plan(self) -> None:
        r = self.random
        self.walls, self.persons = [], []
        self.live = not self.alone and r.random() < 0.15
        self.sector, self.speed = WHOLE, 0.0 if self.live else r.choice((0.0, 1.6))
        self.silent = 0.3 if self.live else round(r.uniform(0.15, 0.5), 2)
        self.clear = 0.5 if self.live else round(r.uniform(0, 1), 2)
        self.slow = 0.0 if self.live or r.random() < 0.7 else 0.2
        self.points = r.choice((1, 2, 3))
        lag, braking, top = r.randrange(10, 120), r.uniform(1, 3), r.choice((0.3, 0.6, 1.0))
        self.build(
            (DIFFERENTIAL,) if self.live else (DIFFERENTIAL, OMNIDIRECTIONAL, STEERED), lag, braking, top
        )
        self.unseen, self.blank = (
            0.0,
            r.choice((0.0, math.nan)) if not self.live and r.random() < 0.2 else None,
        )
        self.turn, self.restarts = r.choice((0.0, 0.0, 0.3)), r.random() < 0.2
        self.radius, delay = r.uniform(0.15, 0.3), r.uniform(0, 100)
        self.shape(0.0)
        self.own = 0.1 if not self.live and r.random() < 0.2 else 0.0
        swing = self.base.turn_top * math.hypot(*self.base.sensor[:2])
        seconds = self.silent + (delay + lag + self.tick) / 1000 + 0.02
        self.half = self.radius + 0.08 + (top + swing + self.speed) * seconds
        self.half += (self.speed + swing + top / 2) * top / braking
        """The least distance of the edge of the zone from the scanner."""
        self.muted_from, self.muted_until = -NEVER, NEVER
        self.occupied_at, self.occupied = NEVER, False
        self.occupied_since: int | None = None
        """When the first scan with something in the zone arrived that no free one has followed."""
        self.scan_occupied = False
        """Whether the scan that is made now surely has something in the zone."""
        self.ready: set[int] = set()
        self.around = r.random() < 0.5
        """Whether the zone is around the scanner, and protects the base."""
        self.corners = (
            FRONT if self.live and not self.around else self._surrounding() if self.around else self._any()
        )
        if self.live:
            self.half, self.honest, self.span = 1.0, (0.3, 1.2), 6000
            self.walls = geometry.edges([(-5, -5), (9, -5), (9, 5), (-5, 5)])
            self.base.heading = 0.0
        else:
            self._around()
        mutes = self.alone == "mute" or (not self.live and r.random() < 0.2)
        values: dict[str, Value] = {
            "slow": self.slow, "points": self.points, "silent": self.silent, "clear": self.clear,
            "muteFor": MUTED if mutes else 0.0, "turn": self.turn, "restarts": self.restarts, "own": self.own,
            "blankIsFree": self.blank is not None, "polygon": " ".join(f"{x},{y}" for x, y in self.corners),
        }  # fmt: skip
        self.guard_with(values, {"by": SCAN})
        self.scanner(r.uniform(25, self.silent * 850), delay)
        if self.live:
            self.every(
                lambda: 100, lambda: void(self.drive(straight(self.honest[0] * (self.now > 1200)))), first=50
            )
            return
        self.drive_to(tuple((one.x, one.y) for one in self.persons) + tuple((w[0], w[1]) for w in self.walls))
        self.every(lambda: r.uniform(300, 1500), lambda: void(self.drive(STILL)), first=r.uniform(0, 1000))
        if mutes:
            self.after(r.uniform(500, 4000), self._mute)
        if r.random() < 0.4:
            self.after(r.uniform(300, 6000), self._fail)
        self.with_second()
        self.interrupt(0.25)

    def _surrounding(self) -> Sequence[Point]:
        """Return the corners of a polygon, in either turn, whose edges touch a circle around the scanner."""
        r = self.random
        sides, near = r.randrange(4, 9), 1.0 if self.live else self.half
        step = 2 * math.pi / sides
        angles = [(side + r.uniform(-0.1, 0.1)) * step for side in range(sides)]
        corners = []
        for one, other in zip(angles, [*angles[1:], angles[0] + 2 * math.pi], strict=True):
            away, angle = near / math.cos((other - one) / 2) + 0.001, (one + other) / 2
            corners.append((round(away * math.cos(angle), 3), round(away * math.sin(angle), 3)))
        return corners[:: r.choice((1, -1))]

    def _any(self) -> Sequence[Point]:
        """Return corners in turn around a point, so that no edges cross: before, around or beside the scanner."""
        r = self.random
        away, angle, sides = (
            r.choice((0.0, r.uniform(0.3, 2.5))),
            r.uniform(-math.pi, math.pi),
            r.randrange(3, 9),
        )
        corners = []
        for side in range(sides):
            turned, radius = angle + (side + r.uniform(0.1, 0.9)) * 2 * math.pi / sides, r.uniform(0.3, 1.5)
            x, y = radius * math.cos(turned), radius * math.sin(turned)
            corners.append((round(away * math.cos(angle) + x, 3), round(away * math.sin(angle) + y, 3)))
        self.half = max(math.hypot(*corner) for corner in corners)
        return corners

    def _around(self) -> None:
        """Place obstacles and persons; the zone is free at first in most worlds."""
        r = self.random
        for _wall in range(r.choice((1, 2))):
            away, angle = self.half + r.uniform(-0.1, 2), r.uniform(-math.pi, math.pi)
            cos, sin, length = math.cos(angle), math.sin(angle), r.choice((0.5, 10))
            x, y = away * cos * 1.45, away * sin * 1.45
            self.walls.append((x - length * sin, y + length * cos, x + length * sin, y - length * cos))
        for _person in range(r.choice((0, 1, 2)) if self.speed else 0):
            away, angle = 1.45 * self.half + r.uniform(0.3, 5), r.uniform(-math.pi, math.pi)
            begins = r.randrange(4000)
            leaves = begins + r.uniform(500, 4000) if r.random() < 0.6 else math.inf
            speed = r.choice((0.5, 1.6))
            self.persons.append(Person(away * math.cos(angle), away * math.sin(angle), speed, begins, leaves))

    def scanner(self, period: float, delay: float, exact: "Callable[[], float] | None" = None) -> None:
        super().scanner(period, delay, exact)
        reach = max(math.hypot(*corner) for corner in self.corners)
        self.far, self.angles = max(self.far, 1.1 * reach), np.linspace(-math.pi, math.pi, 360)

    def _mute(self) -> None:
        self.trace("the zone is to be muted")
        self.say("mute", boolean(False), 6)
        self.muted_from, self.muted_until = self.now, self.now + 50 + int(MUTED * 1000) + self.tick + SLACK
        if self.second is not None and self.second.topic == "mute":
            self.muted_until += 4000  # it begins when the other node is silent
        for at in range(self.now + 50, self.now + 4000, 200):
            self.after(at, lambda: void(self.say("mute", boolean(True), 6)))

    def good(self, topic: str) -> bytes:
        return boolean(self.random.random() < 0.8) if topic == "mute" else super().good(topic)

    def source_of(self, topic: str) -> int:
        return 6 if topic == "mute" else super().source_of(topic)

    def counts(self, topic: str) -> bool:
        return topic != "mute"

    def is_motion(self, legs: Legs) -> bool:
        return not self.muted and self._fast(legs)

    @property
    def muted(self) -> bool:
        """Whether the zone may be muted: one node alone says so."""
        second = self.second
        if (
            second is not None
            and second.topic == "mute"
            and second.heard + 50 < self.now < second.heard + 1000
        ):
            return False
        return self.muted_from <= self.now <= self.muted_until

    def scan(self, found: "np.ndarray") -> "tuple[bytes, bool | None]":
        """Note whether a thing is in the zone, also one behind another."""
        part = (np.arange(len(found)) % 180 < 2) & (self.own > 0)  # rays that end at a part of the base
        found[part] = 0.8 * self.own
        hidden = found < self.own
        inside = np.zeros(found.shape, bool)
        x0, y0, turned = self.base.seen_from
        discs = [(person.x, person.y, PERSON_RADIUS) for person in self.persons]
        for walls, persons in [([wall], []) for wall in self.walls] + [([], [disc]) for disc in discs]:
            away = geometry.ranges(x0, y0, self.angles + turned, walls, persons)
            seen = (away < self.far) & (away > max(self.near, self.own)) & ~hidden
            x, y = (
                np.where(seen, away, 0) * np.cos(self.angles),
                np.where(seen, away, 0) * np.sin(self.angles),
            )
            inside |= seen & geometry.are_inside(self.corners, x, y, 0.01)
        self.scan_occupied = int(inside.sum()) >= self.points
        occupied, (data, valid) = self.scan_occupied, super().scan(found)
        return data + bytes([occupied]), valid

    def arrive(self, data: bytes, valid: "bool | None", *, whole: bool) -> None:
        occupied = bool(data[-1]) and bool(valid)
        self.occupied = occupied
        self.occupied_since = (self.occupied_since or self.now) if occupied else None
        if occupied:
            self.occupied_at = self.now
        if occupied and not self.muted:
            self.ready.clear()
        super().arrive(data[:-1], valid, whole=whole)

    def _fast(self, legs: Legs) -> bool:
        turn = 0.0 if self.kind.startswith("ackermann") else math.hypot(*legs[3:])
        return not (math.hypot(*legs[:3]) <= self.slow * (1 + 1e-6) and turn <= self.turn * (1 + 1e-6))

    def _law(self) -> str:
        return "L6" if self.muted_until > NEVER else self.law("L3")

    def receive(self, at: int, topic: str, data: bytes) -> None:
        """Take a message of the guard. After a stop, for any reason, each node stands before it moves."""
        moved = self._fast(self.force[1])
        super().receive(at, topic, data)
        alone = self.beside is None and not self.guard.holds and at > self.fresh_from + 100 + SLACK
        if alone and moved and not self._fast(self.force[1]):
            self.ready.clear()

    def passed(self, node: int, wanted: Legs, got: "Legs | None") -> None:
        unseen = self.now > self.heard + self.silent * 1000 or self.beside_source()
        if unseen and not self.muted and not self.guard.holds:
            self.ready.clear()
        elif not self.moves(wanted) and not self.occupied:
            self.ready.add(node)
        if self.muted or self.guard.holds:
            return
        if got is None or not self._fast(got):
            return
        if self.now < self.occupied_at + self.clear * 1000 and self.now > self.fresh_from:
            self.breach(
                self._law(), f"a motion passes, though something was in the zone at {self.occupied_at} ms"
            )
        if node not in self.ready and not self.slow and not self.restarts:
            self.breach("L6", "a motion passes of a node that has not stood since the last stop")

    def begins_again(self) -> None:
        super().begins_again()
        self.ready.clear()

    def _follow(self, person: Person) -> None:
        """Every direction is in the zone, so no person steps into the way beside it."""

    def watch(self) -> None:
        self.only_fresh()
        if self.muted or self.switched_off or self.now <= self.fresh_from + 100 + SLACK:
            return
        if not self.slow and self.muted_until == NEVER and self.around:
            self.harm()
        if self._fast(self.force[1]):
            since = self.now if self.occupied_since is None or self.foreign else self.occupied_since
            if self.now > since + self.tick + SLACK:
                self.breach("L3", f"something is in the zone since {since} ms, and the base is not stopped")
            self.evidence(self.silent)
