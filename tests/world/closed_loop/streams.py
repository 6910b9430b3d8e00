"""Worlds in which only the commands count that reach a base, and when: all other guards of motions.

A base executes the last command that it got. So each oracle asks which motion is in force, and whether it may be.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from tests.world.closed_loop.messages import (
    ACKERMANN,
    ACKERMANN_STAMPED,
    FIX,
    IMU,
    ODOMETRY,
    RANGE,
    SCAN,
    STILL,
    TWIST,
    TWIST_STAMPED,
    Legs,
    battery,
    boolean,
    header,
    odometry,
    position,
    steering,
    values,
)
from tests.world.closed_loop.world import NEVER, SLACK, World

VELOCITIES = (TWIST, TWIST, TWIST, TWIST_STAMPED, ACKERMANN, ACKERMANN_STAMPED)


def straight(speed: float, turning: float = 0.0) -> Legs:
    return (speed, 0.0, 0.0, 0.0, 0.0, turning)


@dataclass
class Driver:
    """A node that commands motions, and what has reached the guard."""

    node: int
    heard: int = NEVER
    wants_motion: bool = False
    got_at: int = NEVER
    """When the base last got a motion of this node."""
    stopped_at: int = NEVER
    broke_at: int = NEVER
    """When a message came after a silence."""


class DeadmanWorld(World):
    """One or two nodes drive over links that break, and deliver late what they held."""

    preset: ClassVar[str] = "deadman"

    def plan(self) -> None:
        r = self.random
        self.kind = r.choice(VELOCITIES)
        self.silent = round(r.uniform(0.1, 1), 2)
        self.guarded({"silent": self.silent})
        self.live = r.random() < 0.15
        self.sent = self.got = 0
        self.drivers = {node: Driver(node) for node in range(1, 2 if self.live else r.choice((2, 3)))}
        for driver in self.drivers.values():
            self._streams(driver)
        if not self.live:
            self.interrupt(0.35)

    def _streams(self, driver: Driver) -> None:
        r = self.random
        period = r.uniform(20, min(self.silent * 850, 300))
        cut_from, cut_until = float(self.span), 0.0
        if not self.live:
            cut_from = r.uniform(500, 6000)
            cut_until = cut_from + r.choice(
                (self.silent * 1000 + r.uniform(60, 2500), r.uniform(10, 500), self.span)
            )
        held: list[tuple[Legs, int]] = []
        holds, ends = r.random() < 0.7, r.random() < 0.5
        legs = straight(0.5, 0.1)

        def send() -> None:
            nonlocal legs
            if not self.live and r.random() < 0.05:
                legs = r.choice(
                    (STILL, straight(0.7), straight(0.0, 0.4), straight(-0.3), straight(math.nan))
                )
            if cut_from <= self.now < cut_until:
                held.append((legs, self.now))
                return
            if cut_until <= self.now and ends and cut_until:
                return
            self.drive(legs, driver.node)

        def deliver() -> None:
            for legs, made in held[-40:] if holds else ():
                self.drive(legs, driver.node, made)
            held.clear()

        self.every(lambda: period * r.uniform(0.8, 1.1), send, first=r.uniform(0, 400))
        if cut_until < self.span and cut_until:
            self.after(cut_until, deliver)

    def passed(self, node: int, wanted: Legs, got: "Legs | None") -> None:
        driver = self.drivers[node]
        if self.now - driver.heard > self.silent * 1000 + SLACK:
            driver.broke_at = self.now
        driver.heard, driver.wants_motion = self.now, self.moves(wanted)
        late = (self.now - self.made) / 1000
        if got is not None and self.moves(got):
            driver.got_at = self.now
            if late > self.silent + SLACK / 1000 and driver.broke_at >= self.now - 10:
                self.broken("L6", f"a motion passes that comes {late:.2f} s late, after a silence")
            self.got += self.now > 1500
        self.sent += self.now > 1500

    def received(self, at: int, legs: Legs) -> None:
        super().received(at, legs)
        if not self.moves(legs):
            for driver in self.drivers.values():
                driver.stopped_at = at

    def watch(self) -> None:
        self.only_fresh()
        if self.switched_off or self.guard.holds:
            return
        limit = self.silent * 1000 + SLACK
        for driver in self.drivers.values():
            is_silent = self.now > max(driver.got_at, driver.heard) + limit
            if driver.wants_motion and is_silent and driver.got_at > max(driver.stopped_at, self.fresh_from):
                law = "L4" if len(self.drivers) > 1 and self.force[0] > driver.heard else "L3"
                self.broken(
                    law, f"node {driver.node} is silent since {driver.heard} ms, and no stop has come"
                )

    def ended(self) -> None:
        if self.live and self.got < 0.9 * self.sent:
            self.broken("live", f"of {self.sent} commands of a node that is never silent {self.got} pass")


class SpeedWorld(World):
    """Commands of any size, direction and rate: the norm of the velocity and its growth have a limit."""

    preset: ClassVar[str] = "speed"
    span = 5000

    def plan(self) -> None:
        r = self.random
        self.kind = r.choice(VELOCITIES)
        self.most, self.turn = round(r.uniform(0.1, 3), 2), round(r.uniform(0.1, 3), 2)
        self.growth, self.turn_growth = round(r.uniform(0.2, 20), 2), round(r.uniform(0.2, 20), 2)
        self.guarded(
            {"vMax": self.most, "wMax": self.turn, "aMax": self.growth, "alphaMax": self.turn_growth}
        )
        self.before: tuple[int, float, float] = (NEVER, 0.0, 0.0)
        self.live = r.random() < 0.2
        self.interrupt(0 if self.live else 0.3)
        period = r.choice((10, 20, 50, 100, 300))
        legs = straight(0.9 * self.most, 0.0)

        def send() -> None:
            nonlocal legs
            if not self.live and r.random() < 0.2:
                size = r.choice((0.0, 0.1, 1.0, 9.0, 1e300, math.inf, math.nan))
                legs = tuple(size * r.choice((0, 1, -1, 0.5, r.random())) for _axis in range(6))  # type: ignore[assignment]  # six
            self.drive(legs)

        self.every(
            lambda: period * r.uniform(0.9, 1.1) if self.live or r.random() > 0.02 else r.uniform(900, 1500),
            send,
            first=100,
        )

    def passed(self, node: int, wanted: Legs, got: "Legs | None") -> None:
        if got is None:
            return
        steered = self.kind.startswith("ackermann")
        speed, turn = math.hypot(*got[:3]), 0.0 if steered else math.hypot(*got[3:])
        if not (math.isfinite(speed) and math.isfinite(got[5]) and math.isfinite(turn)):
            self.broken("L2", "a velocity that is not a number passes a limit of velocities")
        if speed > self.most * (1 + 1e-6) or turn > self.turn * (1 + 1e-6):
            self.broken(
                "L1", f"{speed:.3f} m/s and {turn:.3f} rad/s pass; {self.most} and {self.turn} are permitted"
            )
        at, before, turned = self.before
        seconds = max(0.1, (self.now - at) / 1000)
        rounded = 1 + 1e-6  # the Ackermann types have numbers of 32 bits
        if (
            speed > (before + self.growth * seconds) * rounded
            or turn > (turned + self.turn_growth * seconds) * rounded
        ):
            law = "L6" if self.fresh_from > at else "L1"
            self.broken(
                law,
                f"{before:.3f} m/s grow to {speed:.3f}, {turned:.3f} rad/s to {turn:.3f} in {seconds:.2f} s",
            )
        self.before = (self.now, speed, turn)

    def received(self, at: int, legs: Legs) -> None:
        super().received(at, legs)
        if not self.moves(legs):
            self.before = (at, 0.0, 0.0)

    def watch(self) -> None:
        self.only_fresh()

    def ended(self) -> None:
        needed = (
            self.most / self.growth * 1.5
        )  # commands that come less often than every 0.2 s grow more slowly
        if self.live and needed < 2 and abs(self.force[1][0] - 0.9 * self.most) > 1e-5:
            self.broken(
                "live", f"a permitted {0.9 * self.most:.2f} m/s is {self.force[1][0]:.2f} m/s in the end"
            )


class SaneWorld(World):
    """Commands with numbers that are infinite or NaN, in any field that moves or steers."""

    preset: ClassVar[str] = "sane"
    span = 3000

    def plan(self) -> None:
        r = self.random
        self.kind = r.choice(VELOCITIES)
        self.guarded({})
        self.interrupt()
        self.whole = True
        self.every(lambda: r.choice((20, 100, 300)), self._send, first=50)

    def _send(self) -> None:
        r = self.random
        bad = r.choice((math.nan, math.inf, -math.inf))
        wrong = r.randrange(12)
        if self.kind.startswith("ackermann"):
            parts = [bad if place == wrong else r.uniform(-1, 1) for place in range(5)]
            self.whole = wrong >= 5
            data = steering(*parts)
            self.publish(header(self.now) + data if self.kind == ACKERMANN_STAMPED else data)
            return
        self.whole = wrong >= 6
        self.drive(tuple(bad if place == wrong else r.uniform(-1, 1) for place in range(6)))  # type: ignore[arg-type]  # six

    def passed(self, node: int, wanted: Legs, got: "Legs | None") -> None:
        if not self.whole and got is not None and self.moves(got):
            self.broken(
                "L1" if self.kind.startswith("ackermann") else "L2", "a command passes that is not finite"
            )
        if self.whole and got != wanted and not self.guard.holds:
            self.broken("live", "a finite command does not pass")

    def watch(self) -> None:
        self.only_fresh()


class RateWorld(World):
    """Commands that come too often: few of them pass, but none that slows."""

    preset: ClassVar[str] = "rate"
    span = 4000

    def plan(self) -> None:
        r = self.random
        self.kind = r.choice(VELOCITIES)
        self.interval, self.burst = round(r.uniform(0.02, 0.3), 3), r.choice((1, 2, 5))
        self.guarded({"interval": self.interval, "burst": self.burst})
        self.interrupt()
        self.motions: list[int] = []
        self.last: Legs = STILL
        self.every(lambda: r.choice((1, 5, 20, 100, 400, self.interval * 1100)), self._send, first=50)

    def _send(self) -> None:
        speed = self.random.choice((0.0, 0.1, 1.0, 1.0, 5.0, 9.0))
        self.last = straight(speed, self.random.choice((0.0, 0.0, 0.2)))
        self.drive(self.last)

    def passed(self, node: int, wanted: Legs, got: "Legs | None") -> None:
        if got is None and not self.moves(wanted) and not self.guard.holds:
            self.broken("L3", "a stop is dropped")
        slower = self._slower(wanted, self.before)
        if got is not None and self.moves(got) and not slower:
            # After a hold, a restart or an `enable`, a burst may come again.
            self.motions = [*(at for at in self.motions if at >= self.fresh_from), self.now]
            for count in range(self.burst + 1, min(30, len(self.motions)) + 1):
                seconds = (self.motions[-1] - self.motions[-count]) / 1000
                if count > self.burst + 1 + seconds / self.interval + 1e-6:
                    self.broken(
                        "L3", f"{count} motions, none slower than the one before, pass in {seconds:.3f} s"
                    )
        if got is None and slower and not self.guard.holds:
            self.broken("L3", f"{wanted[0]} m/s is dropped while {self.before[0]} m/s is in force")

    def _slower(self, one: Legs, other: Legs) -> bool:
        turns = (0.0, 0.0) if self.kind.startswith("ackermann") else (abs(one[5]), abs(other[5]))
        speeds = (abs(one[0]), abs(other[0]))
        return (
            speeds[0] <= speeds[1] and turns[0] <= turns[1] and (speeds[0] < speeds[1] or turns[0] < turns[1])
        )

    before: Legs = STILL

    def publish(self, data: bytes, node: int | None = None) -> "Legs | None":
        self.before = self.force[1]
        return super().publish(data, node)

    def watch(self) -> None:
        self.only_fresh()


class EvidenceWorld(World):
    """Commands at a steady rate that need the evidence of sensors; `fit_until` says how long it lasts."""

    span = 6000
    steady = 1.0
    sent = got = 0
    fit_since = NEVER
    """Since when an honest node's commands must pass; `NEVER`: they need not."""

    def fit(self) -> str:
        """Return why nothing may move at present, or an empty text."""
        raise NotImplementedError

    def commands(self, period: float, kinds: "tuple[str, ...]" = VELOCITIES) -> None:
        self.kind = self.random.choice(kinds)
        self.every(lambda: period * self.random.uniform(0.8, 1.2), self._send, first=30)

    def _send(self) -> None:
        self.drive(straight(self.steady) if self.random.random() > 0.03 else STILL)

    def passed(self, node: int, wanted: Legs, got: "Legs | None") -> None:
        if got is not None and self.moves(got) and (why := self.fit()):
            self.broken(self.law(), f"a motion passes: {why}")
        if self.fit_since != NEVER and self.now > self.fit_since and self.moves(wanted):
            self.sent += 1
            self.got += got == wanted

    def law(self) -> str:
        return "L4" if self.foreign else "L2"

    def watch(self) -> None:
        self.only_fresh()
        why = self.fit()
        self.unfit_from = (self.unfit_from if self.unfit_from != NEVER else self.now) if why else NEVER
        if self.switched_off or not why or self.now <= self.unfit_from + self.tick + SLACK:
            return
        if self.fresh_from < self.force[0] < self.now and self.moves(self.force[1]):
            self.broken(self.law(), f"a motion stays in force: {why}")

    unfit_from = NEVER

    def ended(self) -> None:
        if self.got < 0.95 * self.sent:
            self.broken("live", f"of {self.sent} commands with all evidence {self.got} pass")


SENSOR_VALUES = {SCAN: 20, RANGE: 1, ODOMETRY: 7, FIX: 3, IMU: 6}


class SensorWorld(EvidenceWorld):
    """A sensor that is silent, frozen, blind or unreadable."""

    preset: ClassVar[str] = "sensor"
    one_source: ClassVar[Mapping[str, tuple[str, ...]]] = {"by": ("dead", "cut")}

    def plan(self) -> None:
        r = self.random
        self.by = r.choice(list(SENSOR_VALUES))
        self.silent, self.frozen = round(r.uniform(0.1, 1), 2), r.choice((0, 2, 5, 20))
        self.least = r.choice((0.1, 0.5, 1.0))
        self.commands(r.choice((30, 100, 250)))
        self.guarded({"silent": self.silent, "frozen": self.frozen, "least": self.least}, {"by": self.by})
        self.heard, self.repeated, self.seeing, self.fault = NEVER, 0, False, ""
        self.known: list[float] = []
        self.shown: list[float] = []
        live = not self.alone and r.random() < 0.2
        self.fit_since = 1500 if live else NEVER
        if not live:
            self.after(r.uniform(500, 4000), self._fail)
            self.with_second()
            self.interrupt()
        period = r.uniform(15, min(200, self.silent * 800))
        self.every(
            lambda: -1 if self.fault == "dead" else period * r.uniform(0.7, 1),
            self._sense,
            first=r.uniform(0, 300),
        )

    def _fail(self) -> None:
        self.fault = self.random.choice(("dead", "frozen", "NaN", "infinite", "some", "cut", "frozen NaN"))
        self.trace(f"the sensor fails: {self.fault}")
        if self.fault != "dead" and self.random.random() < 0.5:
            self.after(self.now + self.random.uniform(300, 2000), lambda: setattr(self, "fault", ""))

    def begins_again(self) -> None:
        super().begins_again()
        self.shown, self.repeated = [], 0  # the guard counts from its new beginning

    def forgets(self) -> None:
        self.seeing, self.shown, self.repeated = False, [], 0

    def good(self, topic: str) -> bytes:
        return values(
            self.by, self.now, [self.random.uniform(1, 5) for _value in range(SENSOR_VALUES[self.by])]
        )

    def _sense(self) -> None:
        r = self.random
        count = SENSOR_VALUES[self.by]
        if self.fault == "dead":
            return
        if self.fault != "frozen" or not self.known:
            self.known = [r.uniform(1, 5) for _value in range(count)]
        numbers = list(self.known)
        match self.fault:
            case "NaN":
                numbers = [math.nan] * count
            case "frozen NaN":
                numbers = [1.0 if place % 3 == 0 else math.nan for place in range(count)]
            case "infinite":
                numbers = [r.choice((math.inf, -math.inf)) for _value in range(count)]
            case "some":
                numbers = [one if r.random() < 0.4 else math.nan for one in numbers]
        if self.fault == "cut":
            self.say("by", values(self.by, self.now, numbers)[:14], whole=False)
            self.seeing, self.shown = False, []
            return
        finite = sum(map(math.isfinite, numbers))
        same = repr(numbers) == repr(self.shown)
        self.repeated = self.repeated + 1 if same else 0
        hears = self.second is None or not self.second.in_doubt
        self.shown = numbers if hears else []
        self.seeing, self.heard = finite > 0 and finite >= self.least * count, self.now
        self.say("by", values(self.by, self.now, numbers))

    def fit(self) -> str:
        if self.now > self.heard + self.silent * 1000:
            return f"the sensor is silent since {self.heard} ms"
        if not self.seeing:
            return "the sensor is blind or unreadable"
        if self.frozen and self.repeated >= self.frozen:
            return f"the sensor has repeated its values {self.repeated} times"
        return ""


class ArmWorld(EvidenceWorld):
    """A battery, a position fix and a check, each of which may be absent, old, invalid or too low."""

    preset: ClassVar[str] = "arm"
    one_source: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "by": ("no battery", "cut"),
        "fix": ("no fix",),
        "check": ("no check",),
    }
    span = 8000
    tick = 100

    def plan(self) -> None:
        r = self.random
        self.silent, self.checked = round(r.uniform(0.3, 2), 2), r.choice((1, 3, 600))
        self.charge, self.needs_fix, self.needs_check = (
            round(r.uniform(0.1, 0.5), 2),
            self.alone == "fix" or r.random() < 0.5,
            self.alone == "check" or r.random() < 0.5,
        )
        self.commands(r.choice((30, 100, 250)))
        self.guarded({
            "charge": self.charge, "needFix": self.needs_fix, "needCheck": self.needs_check, "silent": self.silent,
            "checked": self.checked,
        })  # fmt: skip
        self.battery = self.fix = self.check = (NEVER, False)
        self.fault = ""
        live = not self.alone and r.random() < 0.2
        self.fit_since = 1500 if live else NEVER
        period = min(400, self.silent * 800)
        for given in (self._battery, self._fix):
            self.every(lambda: period * r.uniform(0.5, 1), given, first=r.uniform(0, 400))
        self.every(lambda: r.uniform(100, 900), self._check, first=r.uniform(0, 500))
        if not live:
            self.with_second()
            self.interrupt()
            for _fault in range(2):
                self.after(r.uniform(500, 6000), self._fail)

    def _fail(self) -> None:
        faults = (
            "low",
            "percent",
            "NaN",
            "minus",
            "cut",
            "no battery",
            "no fix",
            "fix NaN",
            "fix lost",
            "no check",
            "unready",
            "",
        )
        self.fault = self.random.choice(faults)
        self.trace(f"it fails: {self.fault}")

    def begins_again(self) -> None:
        super().begins_again()
        self.battery = self.fix = self.check = (NEVER, False)

    def good(self, topic: str) -> bytes:
        if topic == "by":
            return battery(0.9)
        return boolean(True) if topic == "check" else position(FIX, self.now, 1.0, 1.0, 0)

    def stops_for(self, topic: str) -> float:
        return (self.checked if topic == "check" else self.silent) * 1000

    def counts(self, topic: str) -> bool:
        return {"fix": self.needs_fix, "check": self.needs_check}.get(topic, True)

    def _battery(self) -> None:
        bad = {"low": self.charge - 0.02, "percent": 15.0, "NaN": math.nan, "minus": -1.0}.get(self.fault)
        if self.fault == "no battery":
            return
        data = battery(0.9 if bad is None else bad)
        self.battery = (self.now, bad is None and self.fault != "cut")
        self.say("by", data[:20] if self.fault == "cut" else data, whole=self.fault != "cut")

    def _fix(self) -> None:
        if self.fault == "no fix":
            return
        data = position(FIX, self.now, math.nan if self.fault == "fix NaN" else 1.0, 1.0, 0)
        if self.fault == "fix lost":
            data = header(self.now) + b"\xff" + data[len(header(self.now)) + 1 :]
        self.fix = (self.now, not self.fault.startswith("fix"))
        self.say("fix", data)

    def _check(self) -> None:
        if self.fault == "no check":
            return
        self.check = (self.now, self.fault != "unready")
        self.say("check", boolean(self.check[1]))

    def fit(self) -> str:
        for name, (at, good), wanted, age in (
            ("battery", self.battery, True, self.silent), ("position fix", self.fix, self.needs_fix, self.silent),
            ("check", self.check, self.needs_check, self.checked),
        ):  # fmt: skip
            if wanted and not (good and self.now <= at + age * 1000):
                return f"the {name} is missing or bad"
        return ""


class AgreeWorld(EvidenceWorld):
    """Two sources of the velocity that agree or not, in any part of it."""

    preset: ClassVar[str] = "agree"
    one_source: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "by": ("dead by", "cut by"),
        "other": ("dead", "cut"),
    }

    def plan(self) -> None:
        r = self.random
        self.tolerance, self.samples = 0.1, r.choice((1, 3, 5))
        self.silent = round(r.uniform(0.2, 1), 2)
        self.commands(r.choice((30, 100, 250)))
        self.guarded(
            {"tolerance": self.tolerance, "samples": self.samples, "silent": self.silent},
            {"by": ODOMETRY, "other": ODOMETRY},
        )
        self.fault, self.faulty_since = "", NEVER
        self.heard = {"by": NEVER, "other": NEVER}
        self.count = {"by": 0, "other": 0}
        """Messages since the fault began."""
        live = not self.alone and r.random() < 0.2
        self.fit_since = 1500 if live else NEVER
        if not live:
            self.after(r.uniform(1000, 4000), self._fail)
            self.with_second()
            self.interrupt()
        for given, period in (("by", r.uniform(15, 80)), ("other", r.uniform(15, 80))):
            self._source(given, period)

    def _fail(self) -> None:
        self.fault = self.random.choice(
            ("x", "y", "turn", "opposite turn", "NaN", "dead", "dead by", "both NaN", "cut", "cut by")
        )
        self.trace(f"it fails: {self.fault}")
        self.count = dict.fromkeys(self.count, 0)

    def begins_again(self) -> None:
        super().begins_again()
        self.heard = dict.fromkeys(self.heard, NEVER)
        self.forgets()

    def forgets(self) -> None:
        self.count = dict.fromkeys(self.count, 0)

    def good(self, topic: str) -> bytes:
        return odometry(self.now, (0, 0, 0, 0, 0, 0, 1), (1.0, 0.2, 0.0, 0.0, 0.0, 0.5))

    def _source(self, given: str, period: float) -> None:
        r = self.random

        def say() -> None:
            if self.fault == {"other": "dead", "by": "dead by"}[given]:
                return
            velocity = [1.0 + r.uniform(-0.02, 0.02), 0.2, 0.0, 0.0, 0.0, 0.5]
            if given == "other":
                match self.fault:
                    case "x":
                        velocity[0] = 0.5
                    case "y":
                        velocity[1] = 0.7
                    case "turn":
                        velocity[5] = 2.0
                    case "opposite turn":
                        velocity[5] = -0.5
                    case "NaN":
                        velocity[r.choice((0, 1, 5))] = math.nan
            if self.fault == "both NaN":
                velocity = [math.nan] * 6
            if self.fault == {"other": "cut", "by": "cut by"}[given]:
                self.heard[given] = NEVER
                self.say(given, odometry(self.now, (0, 0, 0, 0, 0, 0, 1), velocity)[:20], whole=False)
                return
            self.heard[given] = self.now
            self.count[given] += 1
            self.say(given, odometry(self.now, (0, 0, 0, 0, 0, 0, 1), velocity))

        self.every(lambda: period * r.uniform(0.8, 1), say, first=r.uniform(0, 300))

    def fit(self) -> str:
        for given, at in self.heard.items():
            if self.now > at + self.silent * 1000:
                return f"{given} is silent since {at} ms"
        differs = self.fault not in {"", "dead", "dead by", "cut", "cut by"}
        if differs and min(self.count.values()) > 2 * self.samples + 1:
            return f"the two do not agree: {self.fault}"
        return ""


@dataclass
class Button:
    """The last message of a node on the topic of a stop or of a reset."""

    on: bool = False
    heard: int = NEVER


class EstopWorld(World):
    """Stop buttons and resets of several nodes: ISO 13850 (stop and reset), ISO 13851 (two hands)."""

    preset: ClassVar[str] = "estop"
    not_yet: ClassVar[Mapping[str, str]] = {
        "a press while it is disabled": "it is not known until the button sends again"
    }
    span = 8000

    def plan(self) -> None:
        r = self.random
        self.kind = r.choice(VELOCITIES)
        self.hands = r.random() < 0.4
        self.silent = r.choice((0.0, 0.3, 1.0))
        self.guarded({"twoHands": self.hands, "silent": self.silent})
        self.stops: dict[int, Button] = {}
        self.resets: dict[int, Button] = {}
        self.edges: dict[int, int] = {}
        self.needs_reset = False
        self.latched_at = NEVER
        self.latched_by = "L6"
        self.doubtful = ""
        """The law that a motion breaks until the guard is resumed."""
        self.reset_at = NEVER
        self.waiting: set[int] = set()
        """Nodes whose next command must stand still."""
        self.live = r.random() < 0.15
        for node in (1, 2) if r.random() < 0.5 else (1,):
            self._drives(node)
        buttons = (3,) if self.live else r.choice(((3,), (3, 4), (3, 4)))
        for node in buttons:
            self._button(node)
        if self.live:
            self._honest()
            return
        for node in (5, 6) if self.hands or r.random() < 0.5 else (5,):
            self._resets(node)
        self.interrupt(0.4)

    def _drives(self, node: int) -> None:
        r = self.random
        period = r.choice((20, 50, 100))
        stubborn = not self.live and r.random() < 0.3

        def send() -> None:
            pause = self.now < 300 or (self.live and 4500 < self.now < 5500)
            self.drive(
                STILL if pause or (not stubborn and not self.live and r.random() < 0.05) else straight(0.5),
                node,
            )

        self.every(lambda: period * r.uniform(0.8, 1.2), send, first=r.uniform(0, 100))

    def _press(self, node: int, on: bool) -> None:
        if not self.switched_off:
            button = self.stops.setdefault(node, Button())
            button.on, button.heard = on, self.now
            if on:
                self._latch()
        self.say("stop", boolean(on), node)
        if on and not self.switched_off and self.moves(self.force[1]):
            self.broken("L3", "a press does not stop the base at once")

    def _latch(self) -> None:
        """Note a stop that only a reset ends."""
        self.needs_reset, self.latched_at = True, self.now
        self.latched_by = "L4" if self.hands or len(self.resets) > 1 else "L6"
        self.edges.clear()

    def _button(self, node: int) -> None:
        r = self.random
        changes = (
            [] if self.live else sorted(r.uniform(1600, 7000) for _change in range(r.choice((0, 2, 2, 3, 4))))
        )
        on = False

        def change(to: bool) -> None:
            nonlocal on
            on = to
            self._press(node, on)

        for number, at in enumerate(changes):
            self.after(at, lambda to=number % 2 == 0: change(to))  # type: ignore[misc]  # bound now
        dies = self.span + 1 if self.live or r.random() < 0.7 else r.uniform(500, 7000)
        begins = 1 if self.live or r.random() < 0.7 else r.uniform(100, 1500)
        self.after(begins, lambda: self._press(node, False))
        if self.silent or r.random() < 0.5:
            period = (self.silent or 0.5) * 400

            def repeat() -> None:
                self._press(node, on)

            self.every(
                lambda: -1 if self.now > dies else period * r.uniform(0.5, 1), repeat, first=begins + 2
            )

    def _reset(self, node: int, on: bool) -> None:
        button = self.resets.setdefault(node, Button())
        edge = on and not button.on and button.heard != NEVER
        if not self.switched_off:
            button.on, button.heard = on, self.now
        if edge and self.needs_reset and not self._pressed() and not self.switched_off:
            self.edges[node] = self.now
            hands = [one for one, at in self.edges.items() if self.now - at <= 2000]
            if len(hands) >= (2 if self.hands else 1):
                self.needs_reset, self.reset_at = False, self.now
                self.waiting = {1, 2}
                self.edges.clear()
        self.say("reset", boolean(on), node)

    def _pressed(self) -> bool:
        return any(button.on for button in self.stops.values())

    def _resets(self, node: int) -> None:
        r = self.random
        habit = r.choice(("edges", "edges", "stuck", "tied", "idle"))

        def act() -> None:
            match habit:
                case "edges":
                    self._reset(node, False)
                    self.after(self.now + r.uniform(5, 250), lambda: self._reset(node, True))
                    self.after(self.now + r.uniform(251, 400), lambda: self._reset(node, False))
                case "stuck":
                    self._reset(node, True)
                case "tied":
                    self._reset(node, self.now > 300)
                case "idle":
                    self._reset(node, False)

        self.every(lambda: r.choice((100, 500, 1500)), act, first=r.uniform(0, 1000))

    def _honest(self) -> None:
        """Plan a press, a release, resets by two nodes, a stop command, and motion."""
        self.after(2000, lambda: self._press(3, True))
        self.after(2500, lambda: self._press(3, False))
        for node in (5, 6):
            for at, on in ((3000, False), (3500 + 10 * node, True), (3900, False)):
                self.after(at, lambda node=node, on=on: self._reset(node, on))  # type: ignore[misc]  # bound now

    def lost(self) -> None:
        self.trace("the process is replaced, and its state is lost")
        self.guard.restart(self.now, lost=True)
        self._doubt("L5")

    def cut(self) -> None:
        self.trace("a button sends bytes that are no message")
        self.say("stop", b"", 3, whole=False)
        self._doubt("L2")

    def _doubt(self, law: str) -> None:
        self.doubtful, self.fresh_from = law, self.now
        self.after(self.now + self.random.choice((50, 300, 1000)), self.resume_guard)

    def resume_guard(self) -> None:
        """Resume the guard: the act of a person, after which each node stands still before it moves."""
        lost_at = self.fresh_from
        super().resume_guard()
        if self.doubtful == "L5":  # nothing is known of a button that has said nothing since
            self.stops = {node: button for node, button in self.stops.items() if button.heard >= lost_at}
            self.needs_reset = self._pressed()
        self.doubtful = ""
        self.waiting = {1, 2}

    def passed(self, node: int, wanted: Legs, got: "Legs | None") -> None:
        if not self.moves(wanted) and not self.needs_reset:
            self.waiting.discard(node)
        if got is not None and self.moves(got):
            self._may_move(node)

    def _may_move(self, node: int) -> None:
        if self.doubtful:
            self.broken(self.doubtful, "a motion passes before a person has resumed the guard")
        pressed = [one for one, button in self.stops.items() if button.on]
        if pressed:
            self.broken(
                "L4" if len(self.stops) > 1 else "L3",
                f"a motion passes while node {pressed[0]} presses the stop",
            )
        if self.needs_reset:
            self.broken(
                self.latched_by, f"a motion passes without a reset after the stop at {self.latched_at} ms"
            )
        if node in self.waiting:
            self.broken(
                "L6",
                f"node {node} has not stood still since the reset at {self.reset_at} ms, or a resume",
            )
        if self.silent and not self.stops:
            self.broken("L2", "a motion passes before the first word of a button")
        for one, button in self.stops.items():
            if self.silent and self.now > button.heard + self.silent * 1000 + 100 + SLACK:
                self.broken(
                    "L4", f"a motion passes while the button of node {one} is silent since {button.heard} ms"
                )

    def watch(self) -> None:
        self.only_fresh()
        if self.switched_off or not self.moves(self.force[1]):
            return
        for one, button in self.stops.items():
            if self.silent and self.now > button.heard + self.silent * 1000 + 100 + SLACK:
                self.broken("L4", f"a motion stays in force while the button of node {one} is silent")

    def ended(self) -> None:
        if self.live and not self.moves(self.force[1]):
            self.broken("live", "after a release, a reset and a stop command a motion does not pass")
