"""Worlds of the guards that need the evidence of sensors: `sensor`, `arm` and `agree`.

A base executes the last command that it got. So each oracle asks whether the motion in force has its evidence.
"""

import math
from collections.abc import Mapping
from typing import ClassVar

from lab.closed_loop.messages import (
    FIX,
    IMU,
    ODOMETRY,
    RANGE,
    SCAN,
    STILL,
    VELOCITIES,
    Legs,
    battery,
    boolean,
    header,
    odometry,
    position,
    straight,
    values,
)
from lab.closed_loop.world import NEVER, SLACK, World


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
        if got is not None and self.moves(got):
            if why := self.fit():
                self.breach(self.law(), f"a motion passes: {why}")
            self.unfit_from = NEVER  # it was fit between two looks
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
            self.breach(self.law(), f"a motion stays in force: {why}")

    unfit_from = NEVER

    def ended(self) -> None:
        if self.got < 0.95 * self.sent:
            self.breach("live", f"of {self.sent} commands with all evidence {self.got} pass")


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
        self.guard_with({"silent": self.silent, "frozen": self.frozen, "least": self.least}, {"by": self.by})
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
                numbers = [number if r.random() < 0.4 else math.nan for number in numbers]
        if self.fault == "cut":
            self.say("by", values(self.by, self.now, numbers)[:14], whole=False)
            self.seeing, self.shown = False, []
            return
        finite = sum(map(math.isfinite, numbers))
        beyond = {SCAN: (math.inf,), RANGE: (math.inf, -math.inf)}.get(self.by, ())
        valid = finite + sum(map(numbers.count, beyond))
        same = repr(numbers) == repr(self.shown) and finite >= 10
        self.repeated = self.repeated + 1 if same else 0
        hears = self.second is None or not self.second.in_doubt
        self.shown = numbers if hears else []
        self.seeing, self.heard = valid > 0 and valid >= self.least * count, self.now
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

    preset: ClassVar[str] = "ready"
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
        self.hundred, self.most = r.random() < 0.3, r.choice((1, 1.3))
        self.commands(r.choice((30, 100, 250)))
        self.guard_with({
            "charge": self.charge, "hundred": self.hundred, "needFix": self.needs_fix, "needCheck": self.needs_check,
            "silent": self.silent, "checked": self.checked, "most": self.most,
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
            return battery(90 if self.hundred else 0.9)
        return boolean(True) if topic == "check" else position(FIX, self.now, 1.0, 1.0, 0)

    def stops_for(self, topic: str) -> float:
        return (self.checked if topic == "check" else self.silent) * 1000

    def counts(self, topic: str) -> bool:
        return {"fix": self.needs_fix, "check": self.needs_check}.get(topic, True)

    def _battery(self) -> None:
        wrong = (
            0.9 if self.hundred else 15.0
        )  # of 1, where the guard takes it for one of 100, or the other way
        bad = {"low": self.charge - 0.02, "NaN": math.nan, "minus": -1.0}.get(self.fault)
        charge = (self.most - 0.1 if bad is None else bad) * (100 if self.hundred else 1)
        if self.fault == "no battery":
            return
        data = battery(wrong if self.fault == "percent" else charge)
        self.battery = (self.now, bad is None and self.fault not in {"cut", "percent"})
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
        self.tolerance, self.turning = r.choice((0.05, 0.1, 0.4)), r.choice((0.1, 0.2, 0.8))
        self.samples = r.choice((1, 3, 5))
        self.silent = round(r.uniform(0.2, 1), 2)
        self.commands(r.choice((30, 100, 250)))
        self.guard_with(
            {
                "tolerance": self.tolerance,
                "turning": self.turning,
                "samples": self.samples,
                "silent": self.silent,
            },
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
                        velocity[0] = 0.97 - self.tolerance
                    case "y":
                        velocity[1] += self.tolerance + 0.01
                    case "turn":
                        velocity[5] += self.turning + 0.01
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
