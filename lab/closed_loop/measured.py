"""Worlds of the guards that judge the measured velocity of a base, which may not obey: `overspeed` and `standstill`."""

import math
from collections.abc import Mapping
from typing import ClassVar

from lab.closed_loop.bases import DIFFERENTIAL, OMNIDIRECTIONAL, STEERED, Base
from lab.closed_loop.messages import (
    ACKERMANN,
    ACKERMANN_STAMPED,
    ODOMETRY,
    STILL,
    TWIST,
    TWIST_STAMPED,
    Legs,
    odometry,
    straight,
)
from lab.closed_loop.world import NEVER, SLACK, World

KINDS = {
    DIFFERENTIAL: (TWIST, TWIST_STAMPED),
    OMNIDIRECTIONAL: (TWIST, TWIST_STAMPED),
    STEERED: (ACKERMANN, ACKERMANN_STAMPED),
}
TICK = 20
"""Milliseconds between two looks of these guards."""
FAULTS = ("dead", "NaN", "infinite", "cut")


class MeasuredWorld(World):
    """A base that at times drives without a command, and its odometry, which may fail."""

    one_source: ClassVar[Mapping[str, tuple[str, ...]]] = {"by": ("dead", "cut")}
    still: float
    silent: float
    waits = True
    """Whether a node must command zero, while the base is measured as standing, before a motion passes."""

    def begun(self, top: float) -> None:
        r = self.random
        kind = r.choice((DIFFERENTIAL, OMNIDIRECTIONAL, STEERED))
        self.kind = r.choice(KINDS[kind])
        self.base = Base(kind, r.randrange(10, 150), r.uniform(1, 4), r.uniform(1, 8), top)
        self.base.turn_gathering = r.choice((math.inf, 3.0))
        self.still = r.choice((0.03, 0.05, 0.1))
        self.push: tuple[float, float] = (0.0, 0.0)
        """Velocities, linear and angular, that no command asks for."""
        self.live = not self.alone and r.random() < 0.2
        self.silent = round(r.uniform(0.1, 0.6), 2)
        self.fault = ""
        self.quiet = r.random() < 0.5  # it commands zero once
        self.measure: tuple[int, float, float] = (NEVER, math.nan, math.nan)
        self.bad_from = NEVER
        """Since when each measurement is not a number."""
        self.sent = self.passing = 0

    def happens(self) -> None:
        """Plan commands, measurements and faults."""
        r = self.random
        period = r.uniform(15, self.silent * 800)
        self.every(lambda: period * r.uniform(0.7, 1), self._sense, first=r.uniform(0, 200))
        commands = r.choice((30, 100))
        self.every(lambda: commands * r.uniform(0.8, 1.2), self._command, first=r.uniform(0, 100))
        if self.live:
            return
        for _push in range(r.choice((0, 1, 1, 2))):
            self.after(r.uniform(500, 6000), self._pushes)
        if r.random() < 0.5:
            self.after(r.uniform(500, 6000), self._fails)
        self.with_second()
        self.interrupt()

    def _command(self) -> None:
        r = self.random
        stands = self.now < 800 or (not self.live and r.random() < 0.06)
        for_a_while = not self.live and (self.now // 1500) % 3 == 1
        if for_a_while and self.quiet and not self.moves(self.force[1]):
            return
        self.drive(STILL if stands or for_a_while else straight(0.4, r.choice((0.0, 0.2))))

    def _pushes(self) -> None:
        r = self.random
        self.push = r.choice(((1.0, 0.0), (0.3, 0.0), (0.0, 2.5), (-1.5, 0.5), (1.2 * self.still, 0.0)))
        self.trace(f"the base moves without a command: {self.push}")
        self.after(self.now + r.uniform(300, 2500), self._ends_push)

    def _ends_push(self) -> None:
        self.push = (0.0, 0.0)

    def _fails(self) -> None:
        self.fault = self.random.choice(FAULTS)
        self.trace(f"the odometry fails: {self.fault}")
        if self.random.random() < 0.6:
            self.after(self.now + self.random.uniform(300, 2000), lambda: setattr(self, "fault", ""))

    def good(self, topic: str) -> bytes:
        return odometry(self.now, (0, 0, 0, 0, 0, 0, 1))

    def forgets(self) -> None:
        self.measure = (NEVER, math.nan, math.nan)
        self.note_measurement()

    def _sense(self) -> None:
        if self.fault == "dead":
            return
        velocity = [
            self.base.vx + self.push[0],
            self.base.vy,
            0.0,
            0.0,
            0.0,
            self.base.turning + self.push[1],
        ]
        if self.fault in {"NaN", "infinite"}:
            velocity[self.random.choice((0, 1, 5))] = math.nan if self.fault == "NaN" else math.inf
        data = odometry(self.now, (0, 0, 0, 0, 0, 0, 1), velocity)
        if self.fault == "cut":
            self.measure = (NEVER, math.nan, math.nan)
            self.note_measurement()
            self.say("by", data[:20], whole=False)
            return
        self.measure = (self.now, math.hypot(*velocity[:3]), abs(velocity[5]))
        bad = self.fault in {"NaN", "infinite"}
        self.bad_from = (self.now if self.bad_from == NEVER else self.bad_from) if bad else NEVER
        self.note_measurement()
        self.say("by", data)
        self.check_act()

    def note_measurement(self) -> None:
        """Note a measurement, before the guard gets it."""

    def check_act(self) -> None:
        """Check the act of the guard at a measurement."""

    def received(self, at: int, legs: Legs) -> None:
        super().received(at, legs)
        self.base.order(at, legs)

    def move(self, until: int) -> None:
        self.base.move(until)

    def unknown(self, slack: int = 0) -> str:
        """Return why the velocity is not known, or an empty text."""
        if self.now > self.measure[0] + self.silent * 1000 + slack:
            return "the odometry is silent or unreadable"
        if self.bad_from != NEVER and self.now > self.bad_from + slack:
            return "the measured velocity is not a number"
        return self.beside_source(slack)

    @property
    def stands(self) -> bool:
        _at, speed, turn = self.measure
        return speed <= self.still and turn <= self.still

    def law(self) -> str:
        return "L4" if self.foreign else "L2"

    def begins_again(self) -> None:
        super().begins_again()
        self.measure, self.bad_from = (NEVER, math.nan, math.nan), NEVER
        self.waits = True

    def ended(self) -> None:
        if self.live and self.passing < 0.95 * self.sent:
            self.breach("live", f"of {self.sent} commands of a base that obeys {self.passing} pass")

    def count(self, wanted: Legs, got: Legs | None) -> None:
        if self.live and self.now > 1500:
            self.sent, self.passing = self.sent + 1, self.passing + (got == wanted)


class OverspeedWorld(MeasuredWorld):
    """A base that at times is faster than its limit, whatever it is commanded."""

    preset: ClassVar[str] = "overspeed"
    span = 7000

    def plan(self) -> None:
        self.begun(1.0)
        self.most, self.turn = round(self.random.uniform(0.45, 1), 2), round(self.random.uniform(0.5, 2), 2)
        self.guard_with(
            {"vMax": self.most, "wMax": self.turn, "still": self.still, "silent": self.silent},
            {"by": ODOMETRY},
        )
        self.happens()

    def _fast(self) -> bool:
        _at, speed, turn = self.measure
        return not (speed <= self.most and turn <= self.turn)

    def note_measurement(self) -> None:
        self.waits = self.waits or self._fast()

    def check_act(self) -> None:
        if self._fast() and not self.foreign and not self.switched_off and self.moves(self.force[1]):
            self.breach("L3", "a measurement is too fast, and does not stop the base at once")

    def passed(self, node: int, wanted: Legs, got: Legs | None) -> None:
        if got is not None and self.moves(got):
            if self.waits:
                self.breach("L6", "a motion passes of a base that has not stood since it was too fast")
            if (why := self.unknown(SLACK)) and self.now > self.fresh_from:
                self.breach(self.law(), f"a motion passes, and {why}")
        if self.unknown():
            self.waits = True
        if not self.moves(wanted) and self.stands and not self.unknown() and not self.guard.holds:
            self.waits = False
        self.count(wanted, got)

    def watch(self) -> None:
        self.only_fresh()
        why = self.unknown(TICK + SLACK)
        if (
            why
            and not self.switched_off
            and self.moves(self.force[1])
            and self.now > self.fresh_from + 100 + SLACK
        ):
            self.breach(self.law(), f"a motion stays in force, and {why}")


class StandstillWorld(MeasuredWorld):
    """A base that is commanded to stand, and at times moves all the same."""

    preset: ClassVar[str] = "standstill"

    def plan(self) -> None:
        self.begun(0.5)
        self.settle = round(self.random.uniform(0.7, 1.5), 2)
        self.guard_with({"settle": self.settle, "still": self.still, "silent": self.silent}, {"by": ODOMETRY})
        self.stopped_at = 0
        """The time of the command to stand; `NEVER` while the base is commanded to move."""
        self.stop_at = 0
        """When the base last got a stop."""
        self.moving_from = NEVER
        """Since when each measurement says that the base moves."""
        self.read = True
        self.happens()

    def received(self, at: int, legs: Legs) -> None:
        super().received(at, legs)
        if self.moves(legs):
            self.stopped_at = NEVER
        else:
            self.stop_at = at
            self.stopped_at = at if self.stopped_at == NEVER else self.stopped_at

    def note_measurement(self) -> None:
        read, self.read = self.read, self.measure[0] != NEVER
        if self.read and not read and self.stopped_at != NEVER:
            self.stopped_at = self.now  # after unreadable bytes the guard begins again
        moves = not self.stands and self.read
        self.moving_from = (self.now if self.moving_from == NEVER else self.moving_from) if moves else NEVER

    def _escaped(self, slack: int) -> bool:
        ready = self.stopped_at != NEVER and self.now > self.stopped_at + self.settle * 1000 + slack
        return ready and (not self.stands or bool(self.unknown(slack)))

    def passed(self, node: int, wanted: Legs, got: Legs | None) -> None:
        if got is not None and self.moves(got):
            if self.waits:
                self.breach("L6", "a motion passes of a base that has not stood since it escaped")
            if (why := self.unknown(SLACK)) and self.now > self.fresh_from:
                self.breach(self.law(), f"a motion passes, and {why}")
        if self.unknown() and not self.guard.holds:  # a guard that holds does not see the command
            self.waits = True
        if not self.moves(wanted) and self.stands and not self.unknown() and not self.guard.holds:
            self.waits = False
        self.count(wanted, got)

    def begins_again(self) -> None:
        super().begins_again()
        self.moving_from = NEVER
        if self.stopped_at != NEVER:
            self.stopped_at = self.now

    def watch(self) -> None:
        self.only_fresh()
        off = self.switched_off or self.guard.holds or self.now <= self.fresh_from + 100 + SLACK
        why = self.unknown(TICK + SLACK)
        if why and not off and self.moves(self.force[1]):
            self.breach(self.law(), f"a motion stays in force, and {why}")
        if self._escaped(TICK + SLACK) and not self.switched_off:
            self.waits = True
        if NEVER in {self.moving_from, self.stopped_at} or off or why:
            return
        due = max(self.moving_from, self.stopped_at + self.settle * 1000) + 150
        if self.now > due and self.now > self.stop_at + 150:
            self.breach(
                "L3", f"the base moves since {self.moving_from} ms, and is not stopped again and again"
            )
