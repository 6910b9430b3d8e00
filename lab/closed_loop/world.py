"""A world in virtual time: a guard, the nodes around it, the commands that reach the base, and the laws that hold.

`worlds.py` names the world of each preset, which says what happens in it; each is one seed.

The laws are those of the guards' page and of the clauses that it names, not of the presets' texts:

- L1  A limit of a velocity shortens the vector and keeps its direction.
- L2  Nothing moves without evidence: after a measurement that is absent, invalid, out of its range or unreadable.
- L3  Nothing collides, and nothing leaves a fence, whatever the age of the last measurement.
- L4  What one node says stays in force when another node says something else.
- L5  A guard that holds lets no motion pass, drops nothing that it only observes, and still knows it afterwards.
- L6  A reset, an `enable`, a restart or a late command moves nothing.
- live  An honest robot in an honest place does move.

The declared assumptions:

- A base stands still at the latest when its `reaction` has passed and it has slowed at `braking` from then on; for a
  fence, after `ahead`. The delay of sensor and network is part of `reaction` or `ahead`.
- A sensor sends at least every `silent` while it works, and the guard's host runs its timers when they are due.
- A person walks at most at `person`, straight at the base, and stops for nothing; only a base that moves towards
  a person or a wall that it touches collides. A person who steps into the base's way from beside it, nearer than
  the separation distance, is not protected: the guard lets a base drive along a wall. For a base that begins to move,
  this counts from the command, which it executes after its lag.
- Between the base's outline and the `margin` are at least 6 cm, for the angles between the rays.
- A link that was cut delivers at once what it held: within 10 ms.
- A position is exact, or wrong by less than half of the `margin`. A scan or a position is never frozen.
"""

import heapq
import math
import random
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

from appliance.features.guards.presets import preset_named
from lab.closed_loop.guard_run import Beside, RunningGuard, parameters_of
from lab.closed_loop.messages import STILL, TWIST, Legs, command, legs_of, moves, travels
from tests.support.features.guards.running_guard import Change, Value, unchanged

NEVER = -(10**9)
SECOND, COMMANDER = 7, 2
"""The node that publishes where another one is the source, and the one that takes over the commands."""
COMMAND = "command"
ACTS = ("hold", "restart", "lost", "switch", "cut")
"""The acts of operators and failures on each guard: it is held and resumed; its process is replaced, and its state kept
or lost; it is disabled and enabled; a source sends bytes that are not a message."""
LAWS = ("L1", "L2", "L3", "L4", "L5", "L6", "live")
SLACK = 30
"""Milliseconds that a guard has for an act: its timers run every 10 or 20 ms."""


@dataclass(frozen=True)
class Violation:
    law: str
    at: int
    text: str

    def __str__(self) -> str:
        return f"{self.law} at {self.at / 1000:.3f} s: {self.text}"


@dataclass
class Report:
    """The simulated seconds of a world, the smallest distance in metres, if any was measured, and the broken laws."""

    seconds: float = 0.0
    clearance: float = float("inf")
    act: str = ""
    """The one of `ACTS` that happened, if any."""
    violations: list[Violation] = field(default_factory=list)
    honest: Counter[str] = field(default_factory=Counter)
    """Honest commands that were `sent` and that `passed`, where a world counts them."""


class BrokenLawError(AssertionError):
    """Ends a world."""


class Companion(Protocol):
    def begin(self) -> Beside:
        """Plan its evidence, and return it."""


@dataclass
class Second:
    """A node that publishes good values on a topic of which another node is the source."""

    topic: str
    heard: int = NEVER
    """When the guard heard it last, since it began."""
    since: int = NEVER
    """When it has begun to speak, so that the base had to stop."""
    in_doubt: bool = False
    """Whether its last bytes were not a message: then the guard hears no other node on this topic."""


class World:
    """One world, by the number of its seed."""

    preset: ClassVar[str]
    span = 8000
    """Milliseconds."""
    tick = 20
    """Milliseconds between two looks of the guard."""
    one_source: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """The topics of which one node is the source, each with the faults by which it is silent or unreadable there."""
    alone = ""
    """Where a second node must publish alone: a topic of `one_source`, or `command`; by default chance decides."""
    fault = ""
    foreign = False
    """Whether another node publishes good values on the sensor's topic."""
    not_yet: ClassVar[Mapping[str, str]] = {}
    """Acts that no world of the preset has, in all worlds or in some, each with the reason."""

    beside: "Companion | None" = None
    """A second guard of the same topic. It may stop what the first one lets pass."""

    tight_cases: ClassVar[tuple[str, ...]] = ()
    """Cases without any reserve, of each ten seeds the first ones: a term that a guard forgets shows in them."""

    def __init__(
        self, seed: int, change: Change = unchanged, trace: Callable[[str], None] | None = None
    ) -> None:
        self.seed = seed
        cases = self.tight_cases if seed % 10 < len(self.tight_cases) else ("",)
        self.case = cases[seed % 10 % len(cases)]
        self.random = random.Random(f"{type(self).__name__} {seed}")  # noqa: S311  a seed gives the same world again
        self.seed = seed
        self.report = Report()
        self.now = 0
        self.kind = TWIST
        self.force: tuple[int, Legs] = (0, STILL)
        """The last command that the base got, and when."""
        self.switched_off = False
        self.holding = False
        """Whether the guard has been made to hold, and is not yet resumed."""
        self.bytes: bytes | None = None
        """The last command, as it left the guard."""
        self.fresh_from = 0
        """A motion is only allowed if its command came after this time."""
        self.made = 0
        """When the command was made that goes through the guard now."""
        self.second: Second | None = None
        self.commander = 1
        """The node that commands the base."""
        self.planned_act = ""
        """The one of `ACTS` that is to happen in this world, if any."""
        self._spoken: set[str] = set()
        """The topics on which the guard has heard the source since it began, so that it hears others."""
        self._known: set[str] = set()
        """The topics whose source has ever sent a message."""
        self._change, self._trace = change, trace
        self._queue: list[tuple[int, int, Callable[[], None]]] = []
        self._number = 0

    def plan(self) -> None:
        """Set up the world: call `guard_with`, and `after` for everything that happens."""
        raise NotImplementedError

    def watch(self) -> None:
        """Check what must hold at any time; called every 10 ms."""

    def passed(self, node: int, wanted: Legs, got: Legs | None) -> None:
        """Check a command that has gone through the guard; None: it was dropped."""

    def ended(self) -> None:
        """Check the whole world."""

    def moves(self, legs: Legs) -> bool:
        return moves(self.kind, legs)

    # For `plan`

    def guard_with(self, values: Mapping[str, Value], types: Mapping[str, str] | None = None) -> None:
        types = {COMMAND: self.kind, **(types or {})}
        values = {name: value for name, value in values.items() if name in parameters_of(self.preset)}
        beside = None if self.beside is None else self.beside.begin()
        self.guard = RunningGuard(self.preset, types, values, self._change, beside)
        self.trace(f"{self.preset} {types} {dict(values)}")

    def tell_beside(self, topic: str, data: bytes) -> None:
        """Publish a message on a topic that only the guard beside this one observes."""
        for one in self.guard.tell(topic, data, self.now, 6)[1]:
            self.receive(*one)

    def after(self, at: float, act: Callable[[], None]) -> None:
        self._number += 1
        heapq.heappush(self._queue, (max(int(at), self.now), self._number, act))

    def every(self, period: Callable[[], float], act: Callable[[], None], *, first: float = 0.0) -> None:
        """Do something again and again; `period()` returns ms, and a negative number ends it."""

        def again() -> None:
            act()
            pause = period()
            if pause >= 0:
                self.after(self.now + max(1, pause), again)

        self.after(first, again)

    def trace(self, text: str) -> None:
        if self._trace is not None:
            self._trace(f"{self.now / 1000:8.3f}  {text}")

    def breach(self, law: str, text: str) -> None:
        if law == "live" and self.beside is not None:
            return
        self.report.violations.append(Violation(law, self.now, text))
        self.trace(f"BROKEN {law}: {text}")
        raise BrokenLawError(text)

    # Events

    def run(self) -> Report:
        self.case = "" if self.alone else self.case
        self.plan()
        self.every(lambda: 10, self._look, first=10)
        try:
            while self._queue and self._queue[0][0] <= self.span:
                at, _number, act = heapq.heappop(self._queue)
                self._reach(at)
                act()
            self._reach(self.span)
            self.ended()
        except BrokenLawError:
            pass
        self.report.seconds = self.now / 1000
        return self.report

    def _reach(self, at: int) -> None:
        for time, topic, data in self.guard.advance(at):
            self.receive(time, topic, data)
        self.move(at)
        self.now = at

    def _look(self) -> None:
        self.watch()
        self._watch_second()

    def move(self, until: int) -> None:
        """Move what moves."""

    def receive(self, at: int, topic: str, data: bytes) -> None:
        if topic == self.guard.topics[COMMAND]:
            self.received(max(at, self.now), legs_of(self.kind, data))

    def received(self, at: int, legs: Legs) -> None:
        """Take a command that the base gets."""
        if legs != self.force[1]:
            self.trace(f"the base gets {_shown(legs)}")
        self.force = (at, legs)

    def say(self, given: str, data: bytes, node: int = 6, *, whole: bool = True) -> bytes | None:
        """Publish a message on a topic of the guard that is not the command's; not `whole`: bytes that are none."""
        held = self.guard.holds
        if given in self.one_source and not self.switched_off:
            self._note(given, node, whole=whole)
        passed, sent = self.guard.tell(self.guard.topics[given], data, self.now, node)
        for one in sent:
            self.receive(*one)
        if passed is None and held and whole and given != COMMAND:
            self.breach(
                "L5", f"a guard that holds drops a message on {self.guard.topics[given]}, which it observes"
            )
        return passed

    def drive(self, legs: Legs, node: int | None = None, made: int | None = None) -> Legs | None:
        """Publish a command that was made at `made` (now) by a node (the commander)."""
        self.made = self.now if made is None else made
        return self.publish(command(self.kind, legs, self.made), node)

    def publish(self, data: bytes, node: int | None = None) -> Legs | None:
        node = self.commander if node is None else node
        legs = legs_of(self.kind, data)
        passed, sent = self.guard.tell(self.guard.topics[COMMAND], data, self.now, node)
        got = None if passed is None else legs_of(self.kind, passed)
        self.bytes = passed
        for one in sent:
            self.receive(*one)
        if got is not None:
            self.received(self.now, got)
            if passed != data:
                self._shortened(legs, got)
            if self.moves(got) and (self.holding or self.guard.holds):
                self.breach("L5", f"a motion passes a guard that holds: {_shown(got)}")
        if not self.switched_off:
            if got is not None and self.is_motion(got) and (why := self.beside_source()):
                self.breach("L4", f"a motion passes: {why}")
            self.passed(node, legs, got)
        return got

    def _shortened(self, wanted: Legs, got: Legs) -> None:
        """Check that the linear velocity keeps its direction, and that no part of it grows."""
        if not travels(got) or not all(map(math.isfinite, wanted[:3])):
            return
        largest = max(abs(leg) for leg in wanted[:3]) or 1e-300
        scale = max(abs(leg) for leg in got[:3]) / largest
        near = 1e-6 * largest * scale
        if scale > 1 + 1e-9 or any(
            not abs(leg * scale - other) <= near for leg, other in zip(wanted[:3], got[:3], strict=True)
        ):
            self.breach("L1", f"{_shown(wanted)} becomes {_shown(got)}: another direction, or more")

    # Another node beside the source

    def good(self, topic: str) -> bytes:
        """Return a message on a topic of `one_source` that permits a motion."""
        raise NotImplementedError

    def source_of(self, topic: str) -> int:
        """Return the node that is the source of a topic of `one_source`."""
        return 6

    def stops_for(self, topic: str) -> float:
        """Return the milliseconds for which a message of another node than the source stops the base."""
        return 1000

    def is_motion(self, legs: Legs) -> bool:
        """Whether the guard has to stop this command when a node publishes beside the source."""
        return self.moves(legs)

    def counts(self, topic: str) -> bool:
        """Whether the guard has to stop while another node than the source publishes on this topic."""
        return True

    def damages(self, topic: str) -> bool:
        """Whether the other node may also send bytes that are not a message."""
        return True

    def forgets(self) -> None:
        """Note that the guard knows nothing any more, because of bytes that were not a message."""

    def with_second(self, part: float = 0.25) -> None:
        """Let, in a part of the worlds, another node publish beside a source, or take over the commands.

        In half of them the source also fails.
        """
        r = self.random
        topics = [*self.one_source]
        if self.alone == COMMAND or r.random() < part / 2:
            self.after(r.uniform(1000, 4000), self._take_over)
        if not self.alone and r.random() >= part:
            return
        topic = r.choice(topics) if self.alone in {"", COMMAND} else self.alone
        begin = r.uniform(1500, 3500)
        if self.alone != COMMAND:
            self.foreign, self.second = True, Second(topic)
            self._speak(topic, begin)
        if faults := self.one_source[topic] if self.alone or r.random() < 0.5 else ():
            self.after(begin + r.uniform(-700, 700), lambda: self._end_source(r.choice(faults)))

    def _take_over(self) -> None:
        self.trace("another node commands the base, and the first one no longer")
        self.commander = COMMANDER

    def _end_source(self, fault: str) -> None:
        self.trace(f"the source fails: {fault}")
        self.fault = fault

    def _speak(self, topic: str, begin: float) -> None:
        r = self.random
        period, end = r.choice((50, 200, 700)), r.choice((self.span, begin + r.uniform(0, 1500)))
        damage = r.choice((0.0, 0.0, 0.0, 0.2)) if self.damages(topic) else 0.0

        def tell() -> None:
            if topic not in self._known:
                return
            data, whole = self.good(topic), r.random() >= damage
            self.say(topic, data if whole else data[: len(data) // 2], SECOND, whole=whole)

        self.every(lambda: -1 if self.now > end else period * r.uniform(0.8, 1), tell, first=begin)

    def _note(self, topic: str, node: int, *, whole: bool) -> None:
        """Note a message, as the guard hears it: after other bytes, it hears their node alone on the topic."""
        second = self.second if self.second is not None and self.second.topic == topic else None
        if not whole:
            in_doubt = second is not None and second.in_doubt
            if (topic not in self._spoken and not in_doubt) if node == SECOND else in_doubt:
                return  # it awaits another node
            since = NEVER if second is None else second.since
            self._forget_second()
            if node == SECOND and second is not None:
                self.trace("another node sends bytes that are no message")
                second.since = since if second.in_doubt else self.now
                second.in_doubt = True
                self.forgets()
        elif node != SECOND:
            self._known.add(topic)
            if second is None or not second.in_doubt:
                self._spoken.add(topic)
        elif second is not None:
            second.in_doubt = False
            if topic in self._spoken:
                second.since = self.now if not self.beside_source() else second.since
                second.heard = self.now

    def _forget_second(self) -> None:
        self._spoken.clear()
        if self.second is not None:
            self.second.heard = self.second.since = NEVER

    def beside_source(self, slack: int = 0) -> str:
        """Return that a node speaks beside the source, so that nothing may move, or an empty text."""
        one = self.second
        if one is None or not self.counts(one.topic) or self.now < one.since + slack:
            return ""
        if not one.in_doubt and self.now >= one.heard + self.stops_for(one.topic) - slack:
            return ""
        return f"another node than the source publishes on `{one.topic}`"

    def _watch_second(self) -> None:
        slack = self.tick + SLACK
        if self.switched_off or self.guard.holds or self.now <= self.fresh_from + 100 + slack:
            return
        if (why := self.beside_source(slack)) and self.is_motion(self.force[1]):
            self.breach("L4", f"a motion stays in force: {why}")

    # Acts of operators

    @classmethod
    def acts(cls) -> tuple[str, ...]:
        """Return what happens to the guard in worlds of this kind."""
        observes = bool(preset_named(cls.preset).given_topics.keys() - {COMMAND})
        return tuple(act for act in ACTS if act not in cls.not_yet and (observes or act != "cut"))

    @classmethod
    def left_out(cls) -> Mapping[str, str]:
        """Return the acts that no world of this kind has, or only some, each with the reason."""
        beside = {"lost beside a second node": "the next node is the source then"} if cls.one_source else {}
        return {**beside, **cls.not_yet}

    def ready_acts(self) -> list[str]:
        """Return the acts that may happen in this world."""
        return [act for act in self.acts() if act != "lost" or self.second is None]

    def interrupt(self, part: float = 0.3) -> None:
        """Plan, in a part of the worlds, one of `ACTS`."""
        if self.random.random() < part:
            self.planned_act = self.random.choice(self.ready_acts())
            self.after(self.random.uniform(0.2, 0.7) * self.span, self._act)

    def _act(self) -> None:
        self.report.act = self.planned_act
        getattr(self, self.planned_act)()

    def hold(self) -> None:
        self.trace("the guard holds")
        self.holding = True
        self.guard.hold()
        self.after(self.now + self.random.choice((50, 300, 1000)), self.resume_guard)

    def resume_guard(self) -> None:
        self.trace("the guard is resumed")
        self.holding = False
        self.guard.resume()
        self.fresh_from = self.now

    def restart(self) -> None:
        self.trace("the process is replaced")
        self.guard.restart(self.now, lost=False)
        self.fresh_from = self.now

    def switch(self) -> None:
        self.trace("the guard is disabled")
        self.switched_off = True
        self.guard.switch(self.now, enabled=False)
        self.after(self.now + self.random.choice((50, 300, 1500)), self.enable_guard)

    def enable_guard(self) -> None:
        self.trace("the guard is enabled")
        self.switched_off = False
        self.guard.switch(self.now, enabled=True)
        self.begins_again()

    def lost(self) -> None:
        self.trace("the process is replaced, and the state of the guard is lost")
        self.guard.restart(self.now, lost=True)
        self.begins_again()

    def cut(self) -> None:
        self.trace("the source sends bytes that are no message")
        topic = self.random.choice([*self.one_source])
        self.say(topic, b"", self.source_of(topic), whole=False)
        self.forgets()

    def begins_again(self) -> None:
        """Note that the guard begins again, and knows nothing."""
        self.fresh_from = self.now
        self._forget_second()

    def only_fresh(self) -> None:
        """Check that no motion from before a restart, an `enable` or a hold is still in force."""
        at, legs = self.force
        if self.switched_off or self.guard.holds or at >= self.fresh_from or not self.moves(legs):
            return
        if self.now > self.fresh_from + 100 + SLACK:
            ago = (self.fresh_from - at) / 1000
            self.breach(
                "L6", f"{_shown(legs)} is in force, which came {ago:.2f} s before the guard began again"
            )


def _shown(legs: Legs) -> str:
    return "(" + ", ".join(f"{leg:.4g}" for leg in legs) + ")"


def void(_result: object) -> None:
    """Take the result of a call whose result does not matter."""
