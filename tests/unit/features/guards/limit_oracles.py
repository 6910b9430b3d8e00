"""Naive models of the guards that judge the numbers of a velocity: by norm, growth, rate, and finite values."""

import math

import numpy as np

from lab.closed_loop.messages import ACKERMANN, STILL, Legs, moves, steering
from tests.unit.features.guards.guarding import seeded
from tests.unit.features.guards.tracing import Trace, finite, motion, near, norm, scaled

HUGE = 1e150
"""A velocity whose square is infinite may become zero."""
SPECIAL = (math.nan, math.inf, -math.inf, 1e300, -1e300, -0.0, 5e-324)


def _limit(trace: Trace, legs: Legs, most: tuple[float, float]) -> None:
    got = trace.command(legs)
    if max(abs(leg) for leg in legs if not math.isnan(leg)) > HUGE:
        assert got is not None and finite(got), trace.said(f"{got} is not finite")
        assert norm(got[:3]) <= most[0] + 1e-6 and norm(got[3:]) <= most[1] + 1e-6, trace.said(
            f"{got} is too fast"
        )
        return
    wanted = (*scaled(legs[:3], most[0]), *scaled(legs[3:], most[1]))
    assert got is not None and near(got, wanted), trace.said(f"{got} is not {wanted}")


def speed_by_norm(seed: int, events: int = 40) -> None:
    """Linear and angular velocities are scaled to their limits, each as a vector, if the growth is not the limit."""
    chance = seeded(seed)
    v_max, w_max = chance.choice((0.0, 0.3, 0.5, 2.0)), chance.choice((0.0, 0.5, 1.0))
    trace = Trace("speed", seed, vMax=v_max, wMax=w_max, aMax=100.0, alphaMax=100.0)
    trace.wait(50)
    trace.command(STILL)
    for _ in range(events):
        trace.wait(chance.randint(100, 900))
        legs = [*motion(chance)]
        if chance.random() < 0.2:
            legs[chance.randrange(6)] = chance.choice(SPECIAL)
        _limit(trace, (legs[0], legs[1], legs[2], legs[3], legs[4], legs[5]), (v_max, w_max))


def _toward(last: tuple[float, ...], wanted: tuple[float, ...]) -> float:
    """Return the part of the last velocity that points in the direction of the new one."""
    size = norm(wanted)
    return max(0.0, sum(one * other for one, other in zip(last, wanted, strict=True)) / size) if size else 0.0


def acceleration(seed: int, events: int = 40) -> None:
    """A velocity grows by `aMax` from the part of the last one in its direction, and from zero after a second.

    A gap counts as 0.2 s at most, and the first as 0.1 s.
    """
    chance = seeded(seed)
    a_max, alpha_max = chance.choice((0.3, 1.0, 5.0)), chance.choice((0.5, 3.0))
    trace = Trace("speed", seed, vMax=2.0, wMax=4.0, aMax=a_max, alphaMax=alpha_max)
    last, at = STILL, -(10**6)
    for _ in range(events):
        trace.wait(chance.randint(1, 150) if chance.random() < 0.9 else chance.choice((999, 1001, 1500)))
        legs = motion(chance)
        late = trace.now - at > 1000
        span, last = (0.1, STILL) if late else (min(0.2, (trace.now - at) / 1000), last)
        linear = _toward(last[:3], legs[:3]) + a_max * span
        turn = _toward(last[3:], legs[3:]) + alpha_max * span
        _limit(trace, legs, (min(2.0, linear), min(4.0, turn)))
        last, at = trace.force, trace.now


def jerk(seed: int, events: int = 40) -> None:
    """Speed, steering, acceleration and jerk of a steered base keep their limits, except those of braking."""
    chance = seeded(seed)
    v_max = chance.choice((2.0, 0.3, 0.7, 1.1))  # most are other numbers in the 32 bits of the message
    limits = {
        "vMax": v_max,
        "aMax": 1.0,
        "jerkMax": chance.choice((2.0, 10.0)),
        "steerMax": 0.6,
        "steerSpeed": chance.choice((0.5, 1.0)),
    }
    trace = Trace("speed", seed, ACKERMANN, **limits)
    last, last_speed, at = 0.0, 0.0, None
    for _ in range(events):
        trace.wait(chance.randint(5, 200))
        numbers = [chance.choice((0.0, 0.2, chance.uniform(-3, 3))) for _ in range(5)]
        if chance.random() < 0.15:
            numbers[chance.randrange(5)] = chance.choice(SPECIAL)
        angle, speed, asked, asked_jerk, rate = numbers
        data = steering(angle, speed, asked, asked_jerk, rate)
        passed, sent = trace.guard.tell(trace.guard.topics["command"], data, trace.now, 1)
        trace.log.append(f"{trace.now} {numbers}")
        assert passed is not None and not sent
        got = struct_of(passed)
        trace.log.append(f"   {got}")
        names = ("steering angle", "steering rate", "speed", "acceleration", "jerk")
        most = (0.6, limits["steerSpeed"], v_max, 1.0, limits["jerkMax"])
        brakes = abs(got[2]) < abs(last_speed) and got[2] * last_speed >= 0
        for name, value, bound in zip(names, got, most, strict=True):
            free = brakes and name in ("acceleration", "jerk")
            assert free or abs(value) <= bound * (1 + 1e-6), trace.said(f"{name} is {value}")
        for index, (wanted, bound) in {
            1: (rate, most[1]),
            3: (asked, most[3]),
            4: (asked_jerk, most[4]),
        }.items():
            if finite((angle, speed, asked, asked_jerk, rate)) and abs(wanted) <= bound:
                assert near((got[index],), (abs(wanted),)), trace.said(
                    f"{names[index]} {wanted} became {got[index]}"
                )
        last_speed = got[2]
        if at is not None and trace.now - at < 1000:
            turned = abs(got[0] - last)
            assert turned <= most[1] * (trace.now - at) / 1000 + 1e-6, trace.said("the steering is faster")
        last, at = got[0], trace.now


def struct_of(data: bytes) -> tuple[float, float, float, float, float]:
    """Return steering angle and its rate, speed, acceleration and jerk of an AckermannDrive."""
    angle, rate, speed, asked, asked_jerk = np.frombuffer(data, dtype="<f4").astype(float)
    return float(angle), float(rate), float(speed), float(asked), float(asked_jerk)


def finite_values(seed: int, events: int = 30) -> None:
    """A command with a number that is not finite is a stop; every other one passes as it is."""
    chance = seeded(seed)
    kind = chance.choice(("geometry_msgs/Twist", "geometry_msgs/TwistStamped", ACKERMANN))
    trace = Trace("sane", seed, kind)
    for _ in range(events):
        trace.wait(chance.randint(1, 200))
        if kind == ACKERMANN:
            numbers = [
                chance.uniform(-2, 2) if chance.random() < 0.8 else chance.choice(SPECIAL) for _ in range(5)
            ]
            data = steering(*numbers)
            good = finite(struct_of(data))
            got = trace.drive(data, 1, numbers)
            assert (got is not None and moves(kind, got)) == (good and struct_of(data)[2] != 0), trace.said(
                "sane"
            )
            continue
        legs = [*motion(chance)]
        for _ in range(chance.choice((0, 0, 1, 2))):
            legs[chance.randrange(6)] = chance.choice(SPECIAL)
        whole: Legs = (legs[0], legs[1], legs[2], legs[3], legs[4], legs[5])
        trace.judge(whole, 1, may=finite(whole), must=finite(whole))


def message_rate(seed: int, events: int = 60) -> None:
    """At most `burst` motions, and one more in each `interval`, pass that are not slower; slower ones always do."""
    chance = seeded(seed)
    interval, burst = chance.choice((20, 50, 200)), chance.choice((1, 2, 5))
    trace = Trace("rate", seed, interval=interval / 1000, burst=burst)
    counted: list[int] = []
    passed_at: list[int] = []
    last = (0.0, 0.0)
    for _ in range(events):
        trace.wait(chance.randint(0, interval) if chance.random() < 0.9 else chance.randint(0, 10 * interval))
        legs = motion(chance)
        size = (norm(legs[:3]), norm(legs[3:]))
        slower = all(one <= other for one, other in zip(size, last, strict=True)) and size != last
        got = trace.command(legs)
        if got is None:
            assert legs != STILL and not slower, trace.said("a slower command must pass")
            all_passed = [*passed_at, trace.now]
            late = any(
                len(all_passed) - i > burst + (trace.now - begin) / interval - 1e-9 - 1
                for i, begin in enumerate(all_passed)
            )
            assert late, trace.said("the rate permits this command")
            continue
        assert got == legs, trace.said(f"{got} is not {legs}")
        passed_at.append(trace.now)
        last = size
        if legs != STILL and not slower:
            counted.append(trace.now)
            for i, begin in enumerate(counted):
                most = burst + (trace.now - begin) / interval
                assert len(counted) - i <= most + 1e-6, trace.said("more commands than the rate permits")
