"""Naive models of the guards that need good evidence: a sensor, two sources, a battery."""

import math

import numpy as np

from lab.closed_loop.messages import Legs, battery, boolean, odometry, scan
from rosmop.tests.acting import message
from tests.unit.features.guards.guarding import seeded
from tests.unit.features.guards.tracing import Source, Trace, finite, motion, pause


def sensor(seed: int, events: int = 60) -> None:
    """A scanner that is silent, frozen or blind, and another node on its topic, stop the base."""
    chance = seeded(seed)
    silent, frozen = chance.choice((100, 500)), chance.choice((0, 2, 5))
    least = chance.choice((0.0, 0.1, 0.5, 1.0))
    trace = Trace("sensor", seed, silent=silent / 1000, frozen=frozen, least=least)
    source = Source(silent)
    before: tuple[float, ...] = ()
    repeated, seen, unsure = 0, False, True
    bad_since: int | None = None
    for i in range(events):
        moved, was, due = trace.moving, trace.now, source.heard + silent
        if seen and (frozen == 0 or repeated < frozen) and source.alone(trace.now, 1000):
            bad_since = None
        trace.wait(pause(chance, silent, 40))
        if moved:
            begin = due if bad_since is None else min(due, bad_since)
            trace.stopped_within(was, begin + 20)
            if bad_since is None and any(at > was for at in trace.stops):
                assert due <= trace.now, trace.said("a stop, and the sensor is not silent")
        if chance.random() < 0.5:
            node = 4 if chance.random() < 0.04 else 3
            values = list(before)
            if not before or chance.random() < 0.6:
                values = [1.0 + i * 1e-3] * 20
                for j in range(chance.choice((0, 0, 0, 8, 10, 18, 20))):
                    values[j] = chance.choice((math.nan, math.inf, -math.inf, 0.05, 31.0))
            data = scan(trace.now, -1, 0.1, 0.1, 30, np.array(values))
            if source.hear(node, trace.now):
                good = sum(1 for value in values if 0.1 <= value <= 30 or value == math.inf)
                seen = good > 0 and good >= least * len(values)
                known = sum(map(math.isfinite, values))
                repeated = repeated + 1 if repr(values) == repr(list(before)) and known >= 10 else 0
                before = tuple(values)
            trace.observe("by", data, node, [round(value, 4) for value in values[:10]])
            fine = seen and (frozen == 0 or repeated < frozen) and source.alone(trace.now, 1000)
            bad_since = None if fine else trace.now if bad_since is None else bad_since
            continue
        good_now = seen and (frozen == 0 or repeated < frozen)
        unsure = not (source.alone(trace.now, 1300) and trace.now - source.heard < silent)
        may = good_now and trace.now - source.heard <= silent + 20 and source.alone(trace.now, 999)
        trace.judge(motion(chance), 1, may=may, must=good_now and not unsure)


def cross_check(seed: int, events: int = 80) -> None:
    """The base moves while two velocities agree for `samples` messages in a row, and both sources are alive."""
    chance = seeded(seed)
    samples, silent = chance.choice((1, 2, 5)), chance.choice((200, 500))
    trace = Trace("agree", seed, samples=samples, silent=silent / 1000)
    sources = {"by": Source(silent), "other": Source(silent)}
    velocity: dict[str, Legs] = {}
    differing = agreeing = 0
    bad_since: int | None = None
    apart = False
    for _ in range(events):
        moved, was = trace.moving, trace.now
        due = min(source.heard + silent for source in sources.values())
        if differing < samples and all(source.alone(trace.now, 1000) for source in sources.values()):
            bad_since = None
        trace.wait(pause(chance, silent, 30))
        if moved:
            begin = due if bad_since is None else min(due, bad_since)
            trace.stopped_within(was, begin + 20)
            if bad_since is None and agreeing >= samples and any(at > was for at in trace.stops):
                assert due <= trace.now, trace.said("a stop, and no source is silent")
        if chance.random() < 0.75:
            given = chance.choice(("by", "other"))
            apart = apart if chance.random() < 0.85 else chance.random() < 0.3
            off = chance.choice((0.2, 0.5)) if apart and given == "other" else 0.0
            legs: Legs = (0.3, off / 2, 0.0, 0.0, 0.0, 0.1 + (off and chance.choice((0.0, 0.5))))
            if off and legs[5] == 0.1:
                legs = (0.3, off, 0.0, 0.0, 0.0, 0.1)
            if chance.random() < 0.01:
                legs = (math.nan, *legs[1:])
            node = (6 if given == "by" else 5) if chance.random() < 0.01 else (3 if given == "by" else 4)
            foreign = not sources[given].hear(node, trace.now)
            if not foreign:
                velocity[given] = legs
            trace.observe(given, odometry(trace.now, (0, 0, 0, 0, 0, 0, 1), legs), node, legs)
            if given == "by" and not foreign and len(velocity) == 2:
                one, other = velocity["by"], velocity["other"]
                same = (
                    finite(one) and finite(other)
                    and math.dist(one[:3], other[:3]) <= 0.1 + 1e-9 and math.dist(one[3:], other[3:]) <= 0.2
                )  # fmt: skip
                alive = trace.now - sources["other"].heard < silent
                agreeing = agreeing + 1 if same and alive else 0
                differing = 0 if same else differing + 1 if finite(one) and finite(other) else samples
            if given == "other" and not foreign and not finite(legs):
                agreeing, differing = 0, samples
            if foreign or differing >= samples:
                bad_since = trace.now if bad_since is None else bad_since
            elif sources["by"].alone(trace.now, 1020) and sources["other"].alone(trace.now, 1020):
                bad_since = None
            continue
        live = all(trace.now - source.heard <= silent + 20 for source in sources.values())
        surely = all(
            trace.now - source.heard < silent and source.alone(trace.now, 1020) for source in sources.values()
        )
        may = live and len(velocity) == 2 and differing < samples
        may = may and all(source.alone(trace.now, 999) for source in sources.values())
        trace.judge(motion(chance), 1, may=may, must=surely and agreeing >= samples)


def arming(seed: int, events: int = 50) -> None:
    """Commands need a charge in 0 to 1 of at least `charge` and, if wanted, a fix and a check that is not too old."""
    chance = seeded(seed)
    silent, checked = chance.choice((500, 2000)), chance.choice((1000, 3000))
    fix, check, hundred = chance.random() < 0.4, chance.random() < 0.4, chance.random() < 0.3
    trace = Trace(
        "ready", seed, charge=0.2, hundred=hundred, needFix=fix, needCheck=check,
        silent=silent / 1000, checked=max(1.0, checked / 1000),
    )  # fmt: skip
    sources = {"by": Source(silent), "fix": Source(silent), "check": Source(checked)}
    good: dict[str, bool] = {}
    bad_since: int | None = None
    wanted = {"by", *(["fix"] if fix else []), *(["check"] if check else [])}

    def armed(later: int = 0, apart: int = 0) -> bool:
        return all(
            good.get(one, False) and trace.now + later - sources[one].heard <= sources[one].silent
            and sources[one].alone(trace.now, apart + sources[one].silent) for one in wanted
        )  # fmt: skip

    for _ in range(events):
        moved, was = trace.moving, trace.now
        due = min(sources[one].heard + sources[one].silent for one in wanted)
        if all(good.get(one, False) and sources[one].alone(trace.now, sources[one].silent) for one in wanted):
            bad_since = None
        trace.wait(pause(chance, silent, 120))
        if moved:
            begin = due if bad_since is None else min(due, bad_since)
            trace.stopped_within(was, begin + 100)
            if bad_since is None and any(at > was for at in trace.stops):
                assert due <= trace.now, trace.said("a stop, and no topic is silent")
        kind = chance.random()
        if kind < 0.5:
            given = chance.choice(("by", "fix", "check"))
            node = 6 if chance.random() < 0.02 else {"by": 3, "fix": 4, "check": 5}[given]
            if given == "by":
                value = chance.choice(
                    (0.9, 0.9, 0.9, 0.5, 0.25, 1.0, 0.0, 0.1, -1.0, 1.5, 80.0, 15.0, 101.0, math.nan)
                )
                part = float(np.float32(value)) / (100 if hundred else 1)
                fine, data = 0.2 <= part <= 1, battery(value)
            elif given == "fix":
                status = chance.choice((0, 0, 0, 1, 2, -1))
                fine, value = status >= 0, float(status)
                data = message(
                    "sensor_msgs/NavSatFix", status__status=status, latitude=1.0, longitude=1.0, altitude=1.0
                )
            else:
                fine = chance.random() < 0.8
                data, value = boolean(fine), float(fine)
            if sources[given].hear(node, trace.now):
                good[given] = fine
            trace.observe(given, data, node, value)
            if all(
                good.get(one, False) and sources[one].alone(trace.now, sources[one].silent + 100)
                for one in wanted
            ):
                bad_since = None
            elif bad_since is None:
                bad_since = trace.now
            continue
        trace.judge(motion(chance), 1, may=armed(-100, -1), must=armed(1, 200))
