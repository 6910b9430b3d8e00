"""Worlds of the guards that judge single commands: `speed`, `sane` and `rate`."""

import math
from typing import ClassVar

from lab.closed_loop.messages import STILL, VELOCITIES, Legs, encode_steering, fields_of, straight
from lab.closed_loop.world import NEVER, World


class SpeedWorld(World):
    """Commands of any size, direction and rate: the norm of the velocity and its growth have a limit."""

    preset: ClassVar[str] = "speed"
    span = 5000

    def plan(self) -> None:
        r = self.random
        self.kind = r.choice(VELOCITIES)
        self.most, self.turn = round(r.uniform(0.1, 3), 2), round(r.uniform(0.1, 3), 2)
        self.growth, self.turn_growth = round(r.uniform(0.2, 20), 2), round(r.uniform(0.2, 20), 2)
        self.angle, self.rate, self.jerk = (round(r.uniform(0.1, most), 2) for most in (1.5, 3, 30))
        self.guard_with({
            "vMax": self.most, "wMax": self.turn, "aMax": self.growth, "alphaMax": self.turn_growth,
            "steerMax": self.angle, "steerSpeed": self.rate, "jerkMax": self.jerk,
        })  # fmt: skip
        self.before: tuple[int, float, float] = (NEVER, 0.0, 0.0)
        self.steering: tuple[int, Legs] = self.force
        """The motion in force before the command that passes now."""
        self.live = r.random() < 0.2
        self.interrupt(0 if self.live else 0.3)
        period = r.choice((10, 20, 50, 100, 300))
        legs = straight(0.9 * self.most, 0.0)

        def send() -> None:
            nonlocal legs
            if not self.live and r.random() < 0.2:
                size = r.choice((0.0, 0.1, 1.0, 9.0, 1e300, math.inf, math.nan))
                legs = tuple(size * r.choice((0, 1, -1, 0.5, r.random())) for _axis in range(6))  # type: ignore[assignment]  # six
            if self.live or not self.kind.startswith("ackermann"):
                self.drive(legs)
                return
            more = [r.choice((0.0, 0.5, -9.0, 99.0, 1e30, math.inf, math.nan)) for _field in range(3)]
            self.publish(encode_steering(self.kind, self.now, [legs[5], legs[0], *more]))

        self.every(
            lambda: period * r.uniform(0.9, 1.1) if self.live or r.random() > 0.02 else r.uniform(900, 1500),
            send,
            first=100,
        )

    def passed(self, node: int, wanted: Legs, got: "Legs | None") -> None:
        if got is None:
            return
        steers = self.kind.startswith("ackermann")
        speed, turn = math.hypot(*got[:3]), 0.0 if steers else math.hypot(*got[3:])
        if not (math.isfinite(speed) and math.isfinite(got[5]) and math.isfinite(turn)):
            self.breach("L2", "a velocity that is not a number passes a limit of velocities")
        if speed > self.most * (1 + 1e-6) or turn > self.turn * (1 + 1e-6):
            self.breach(
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
            self.breach(
                law,
                f"{before:.3f} m/s grow to {speed:.3f}, {turned:.3f} rad/s to {turn:.3f} in {seconds:.2f} s",
            )
        self.before = (self.now, speed, turn)
        if steers and self.bytes is not None:
            self._steered(*fields_of(self.bytes))

    def publish(self, data: bytes, node: int | None = None) -> "Legs | None":
        self.steering = self.force
        return super().publish(data, node)

    def _steered(self, angle: float, rate: float, speed: float, acceleration: float, jerk: float) -> None:
        at, before = self.steering
        most = self.rate * max(0.1, (self.now - at) / 1000) * (1 + 1e-6) + 1e-6
        if not (abs(angle) <= self.angle * (1 + 1e-6) and abs(angle - before[5]) <= most):
            self.breach("L1", f"the steering angle of {before[5]:.3f} rad becomes {angle:.3f}")
        brakes = abs(speed) < abs(before[0]) and speed * before[0] >= 0
        for name, value, limit in (
            ("steering rate", rate, self.rate),
            ("acceleration", acceleration, math.inf if brakes else self.growth),
            ("jerk", jerk, math.inf if brakes else self.jerk),
        ):
            if not abs(value) <= limit * (1 + 1e-6):
                self.breach("L1", f"a {name} of {value:.3f} passes; {limit} is permitted")

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
            self.breach(
                "live", f"a permitted {0.9 * self.most:.2f} m/s is {self.force[1][0]:.2f} m/s in the end"
            )


class SaneWorld(World):
    """Commands with numbers that are infinite or NaN, in any field that moves or steers."""

    preset: ClassVar[str] = "sane"
    span = 3000

    def plan(self) -> None:
        r = self.random
        self.kind = r.choice(VELOCITIES)
        self.guard_with({})
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
            self.publish(encode_steering(self.kind, self.now, parts))
            return
        self.whole = wrong >= 6
        self.drive(tuple(bad if place == wrong else r.uniform(-1, 1) for place in range(6)))  # type: ignore[arg-type]  # six

    def passed(self, node: int, wanted: Legs, got: "Legs | None") -> None:
        if not self.whole and got is not None and self.moves(got):
            self.breach(
                "L1" if self.kind.startswith("ackermann") else "L2", "a command passes that is not finite"
            )
        if self.whole and got != wanted and not self.guard.holds:
            self.breach("live", "a finite command does not pass")

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
        self.guard_with({"interval": self.interval, "burst": self.burst})
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
            self.breach("L3", "a stop is dropped")
        slower = self._slower(wanted, self.before)
        if got is not None and self.moves(got) and not slower:
            # After a hold, a restart or an `enable`, a burst may come again.
            self.motions = [*(at for at in self.motions if at >= self.fresh_from), self.now]
            for count in range(self.burst + 1, min(30, len(self.motions)) + 1):
                seconds = (self.motions[-1] - self.motions[-count]) / 1000
                if count > self.burst + 1 + seconds / self.interval + 1e-6:
                    self.breach(
                        "L3", f"{count} motions, none slower than the one before, pass in {seconds:.3f} s"
                    )
        if got is None and slower and not self.guard.holds:
            self.breach("L3", f"{wanted[0]} m/s is dropped while {self.before[0]} m/s is in force")

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
