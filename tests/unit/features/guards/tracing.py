"""Traces of guards, by seed, for oracles: naive models that are written from the pages and the clauses alone.

An oracle knows nothing of a preset but its name, its topics and its parameters. Where the page leaves a choice, it has
two answers: `may` by the reading that permits most, and `must` by the one that permits least. A motion that passes has
to be one that may; one that must pass has to arrive unchanged. Times are ms.
"""

import math
import random

from lab.closed_loop.guard_run import RunningGuard
from lab.closed_loop.messages import STILL, TWIST, Legs, command, legs_of, moves
from tests.unit.features.guards.guarding import seeded


class Trace:
    """A guard, and what the base gets from it: the velocity in force, and the times of the guard's own stops."""

    def __init__(self, preset: str, seed: int, kind: str = TWIST, **values: bool | float | str) -> None:
        self.random = seeded(seed)
        self.what = f"{preset} seed={seed} {values}"
        self.kind = kind
        types = {"command": kind} if kind != TWIST else {}
        self.guard = RunningGuard(preset, types, values)
        self.now = 0
        self.force: Legs = STILL
        self.stops: list[int] = []
        self.log: list[str] = []

    def _stopped(self, sent: list[tuple[int, str, bytes]]) -> None:
        for at, topic, data in sent:
            if topic == self.guard.topics["command"]:
                assert not moves(self.kind, legs_of(self.kind, data)), self.said("the guard sends a motion")
                self.stops.append(at)
                self.log.append(f"{at} stop")
                self.force = STILL

    def wait(self, ms: int) -> None:
        self.now += ms
        self._stopped(list(self.guard.advance(self.now)))

    def observe(self, given: str, data: bytes, node: int, shown: object) -> None:
        self.log.append(f"{self.now} {given} {shown} of {node}")
        self._stopped(self.guard.tell(self.guard.topics[given], data, self.now, node)[1])

    def command(self, legs: Legs, node: int = 1) -> Legs | None:
        """Return the velocity that passes, or None if the command was dropped."""
        return self.drive(command(self.kind, legs, self.now), node, legs)

    def drive(self, data: bytes, node: int, shown: object) -> Legs | None:
        passed, sent = self.guard.tell(self.guard.topics["command"], data, self.now, node)
        self._stopped(sent)
        self.log.append(f"{self.now} command {shown} of {node}: {passed and legs_of(self.kind, passed)}")
        if passed is None:
            return None
        self.force = legs_of(self.kind, passed)
        return self.force

    @property
    def moving(self) -> bool:
        return moves(self.kind, self.force)

    def said(self, what: str) -> str:
        return f"{self.what} at {self.now}: {what}\n  " + "\n  ".join(self.log[-60:])

    def judge(self, legs: Legs, node: int, *, may: bool, must: bool, drops: bool = False) -> bool:
        """Give a command that passes as it is or is a stop, and return whether it passed as a motion.

        With `drops` it may also be dropped, so that a motion of another node stays in force.
        """
        got = self.command(legs, node)
        if not moves(self.kind, legs):
            assert got == legs, self.said("a command to stand still must pass")
        elif got is not None and moves(self.kind, got):
            assert may, self.said(f"{legs} of {node} may not pass")
            assert got == legs, self.said(f"{legs} became {got}")
        else:
            assert not must, self.said(f"{legs} of {node} must pass")
            stays = got is None and self.moving
            assert drops or not stays, self.said("a dropped command left a motion in force")
        return got is not None and moves(self.kind, got)

    def stopped_within(self, begin: int, end: int) -> None:
        """Assert that the guard sent a stop in these ms, if they are over."""
        if end <= self.now:
            assert any(begin <= at <= end for at in self.stops), self.said(f"no stop in {begin} to {end}")


def pause(chance: random.Random, silent: int, period: int = 60) -> int:
    """Return a time to the next event: mostly short, often about `silent`, at times long."""
    kind = chance.random()
    if kind < 0.8:
        return chance.randint(1, period)
    return (
        silent + chance.choice((-1, 0, 1, 9, 10, 11, 21, 51, 101, 400))
        if kind < 0.95
        else chance.randint(1, 3 * silent)
    )


def motion(chance: random.Random, zero: float = 0.25) -> Legs:
    if chance.random() < zero:
        return STILL
    legs = [chance.choice((0.0, 0.0, chance.uniform(-2, 2))) for _ in range(6)]
    legs[chance.randrange(6)] = chance.choice((0.3, -0.3))
    return (legs[0], legs[1], legs[2], legs[3], legs[4], legs[5])


class Source:
    """A topic with one source: silence, and how long ago another node published."""

    def __init__(self, silent: int) -> None:
        self.silent = silent
        self.node: int | None = None
        self.heard = -(10**9)
        self.stranger = -(10**9)

    def hear(self, node: int, at: int) -> bool:
        """Return whether the message is of the source."""
        self.node = self.node or node
        if node == self.node:
            self.heard = at
            return True
        self.stranger = at
        return False

    def alive(self, at: int) -> bool:
        return at - self.heard <= self.silent

    def alone(self, at: int, apart: int) -> bool:
        return at - self.stranger > apart


def straight(speed: float, direction: float) -> Legs:
    return (speed * math.cos(direction), speed * math.sin(direction), 0.0, 0.0, 0.0, 0.0)


def finite(numbers: tuple[float, ...]) -> bool:
    return all(math.isfinite(number) for number in numbers)


def norm(numbers: tuple[float, ...]) -> float:
    return math.hypot(*numbers)


def slow(legs: Legs, v_max: float, w_max: float) -> bool:
    return math.hypot(*legs[:3]) <= v_max * (1 + 1e-12) and math.hypot(*legs[3:]) <= w_max * (1 + 1e-12)


def scaled(vector: tuple[float, ...], most: float) -> tuple[float, ...]:
    """Return the vector with a norm of at most this; zero if a part is infinite or NaN."""
    if not all(math.isfinite(one) for one in vector):
        return (0.0,) * len(vector)
    norm = math.hypot(*vector)
    return vector if norm <= most else tuple(one * most / norm for one in vector)


def near(one: tuple[float, ...], other: tuple[float, ...], within: float = 1e-6) -> bool:
    return all(abs(a - b) <= within * max(1.0, abs(a), abs(b)) for a, b in zip(one, other, strict=True))
