"""Naive models of the guards that know a place: a fence, and the nearest thing."""

import math

import numpy as np

from lab.closed_loop.messages import ODOMETRY, Legs, position, scan
from tests.unit.features.guards.guarding import seeded
from tests.unit.features.guards.tracing import Source, Trace, norm, pause, straight


def _approaches(place: tuple[float, float], velocity: tuple[float, float], size: float) -> bool:
    """Whether the motion comes nearer to the nearest point of a square with half a side of this size."""
    way = [max(-size, min(size, one)) - one for one in place]
    return way == [0, 0] or way[0] * velocity[0] + way[1] * velocity[1] > -1e-9


def _turned(legs: Legs, heading: float) -> tuple[float, float]:
    """Return the velocity in the frame of the fence."""
    c, s = math.cos(heading), math.sin(heading)
    return legs[0] * c - legs[1] * s, legs[0] * s + legs[1] * c


def fence(seed: int, events: int = 50) -> None:  # noqa: PLR0912  one branch for each rule
    """A motion in a square keeps `margin` to the edge until the next position and for `ahead`; outside it leads inside.

    The base of the trace does not obey its commands: positions are random, so that each case occurs.
    """
    chance = seeded(seed)
    margin, ahead = chance.choice((0.0, 0.2, 0.5)), chance.choice((0.2, 0.5))
    silent = chance.choice((200, 500))
    inward, world = chance.choice((0.1, 0.3)), chance.random() < 0.5
    trace = Trace(
        "fence", seed, margin=margin, ahead=ahead, silent=silent / 1000, inward=inward, worldFrame=world
    )
    source = Source(silent)
    x = y = turned = 0.0
    place = (0.0, 0.0, 0.0, False)
    driven = (0.0, 0.0)
    """At least this way since the position."""
    speeds: list[tuple[int, float]] = []
    """When the base was commanded to move so fast: it still brakes for `ahead`."""
    for _ in range(events):
        moved, was, due = norm(trace.force[:3]) > 0, trace.now, source.heard + silent
        force, at_most, stops = trace.force, norm(trace.force[:3]), len(trace.stops)
        trace.wait(pause(chance, silent, 40))
        if len(trace.stops) == stops:
            wx, wy = _turned(force, 0.0 if world else place[2])
            driven = (driven[0] + wx * (trace.now - was) / 1000, driven[1] + wy * (trace.now - was) / 1000)
        speeds.append((trace.now, at_most))
        if moved:
            trace.stopped_within(was, due + 50)
        if chance.random() < 0.5:
            x, y, turned = chance.uniform(-2.6, 2.6), chance.uniform(-2.6, 2.6), chance.uniform(-3.1, 3.1)
            if chance.random() < 0.5:
                x, y = x / 4, y / 4
            valid = chance.random() < 0.9
            broken = (0.0, 0.0, 0.0, 0.0) if chance.random() < 0.5 else (math.nan,) * 4
            data = position(ODOMETRY, trace.now, x, y, turned, () if valid else broken)
            node = 4 if chance.random() < 0.02 else 3
            if source.hear(node, trace.now):
                place, driven = (x, y, turned, valid), (0.0, 0.0)
            trace.observe("by", data, node, (x, y, turned, valid))
            continue
        legs = straight(chance.choice((0.05, 0.3, 1.0)), chance.uniform(-math.pi, math.pi))
        if chance.random() < 0.2:
            legs = (0.0, 0.0, 0.0, 0.0, 0.0, 0.4)
        got = trace.command(legs)
        assert got is not None, trace.said("a fence drops nothing")
        if norm(legs[:3]) == 0:
            assert got == legs, trace.said("a turn on the spot must pass")
            continue
        speed = norm(got[:3])
        assert speed <= norm(legs[:3]) + 1e-9, trace.said("the fence makes it faster")
        if speed > 0:
            assert abs(got[0] * legs[1] - got[1] * legs[0]) < 1e-9, trace.said("the fence turns the motion")
            assert trace.now - source.heard <= silent + 20, trace.said("the position is silent")
            assert source.alone(trace.now, 999), trace.said("another node publishes positions")
            px, py, heading, known = place
            assert known or world, trace.said("there is no heading")
            heading = 0.0 if world else heading
            wx, wy = _turned(got, heading)
            inside = 2 - margin - max(abs(px), abs(py))
            end = (px + driven[0] + wx * ahead, py + driven[1] + wy * ahead)
            after = 2 - margin - max(abs(end[0]), abs(end[1]))
            if inside < 0:
                assert speed <= inward + 1e-9, trace.said("outside, and too fast")
                leads = any(_approaches((px, py), (wx, wy), size) for size in (2.0, 2 - margin))
                assert leads, trace.said("a motion does not lead inside")
            else:
                assert after >= -1e-6, trace.said(f"the motion ends {-after} m beyond the margin")
        if trace.now - source.heard < silent and source.alone(trace.now, 1020):
            px, py, heading, known = place
            fastest = max(
                [norm(legs[:3]), *(one for at, one in speeds if trace.now - at <= 1000 * ahead + 1000)]
            )
            far = 2 - margin - max(abs(px), abs(py)) - fastest * (1.5 * silent / 1000 + 2 * ahead)
            if far > 0.1 and known:
                assert got == legs, trace.said("far from the edge, and the motion does not pass")


def _separated(  # noqa: PLR0917  the quantities of the formula
    free: float, age: float, reaction: float, braking: float, person: float, margin: float
) -> float:
    """Return the greatest velocity whose ways, those of a person and the margin fit in this distance."""
    a, b = 1 / (2 * braking), age + reaction + person / braking
    c = person * (age + reaction) + margin - free
    return 0.0 if c >= 0 else (-b + math.sqrt(b * b - 4 * a * c)) / (2 * a)


def separation(seed: int, events: int = 25) -> None:
    """A velocity straight ahead, back or to a side passes only as far as the nearest thing in its way permits.

    In a round room, where every direction is as far, the bound is also reached.
    """
    chance = seeded(seed)
    reaction, braking = chance.choice((0.1, 0.2)), chance.choice((0.5, 1.0, 3.0))
    person, margin = chance.choice((1.6, 0.0)), chance.choice((0.0, 0.3))
    silent, width = chance.choice((200, 500)), chance.choice((0.3, 0.5))
    trace = Trace(
        "separation", seed, reaction=reaction, braking=braking, person=person, margin=margin,
        silent=silent / 1000, width=width,
    )  # fmt: skip
    rays = chance.choice((72, 180))
    angles = -math.pi + np.arange(rays) * (2 * math.pi / rays)
    source = Source(silent)
    ranges = np.zeros(0)
    fastest = 0.0
    for _ in range(events):
        moved, was, due = trace.moving, trace.now, source.heard + silent
        trace.wait(pause(chance, silent, 40))
        if moved:
            trace.stopped_within(was, due + 20)
        if chance.random() < 0.5:
            room = chance.choice((0.5, 1.0, 2.0, 4.0, 8.0, 20.0))
            ranges = np.full(rays, room)
            for _thing in range(chance.choice((0, 0, 1, 2))):
                at = chance.randrange(rays)
                ranges[at] = chance.choice((chance.uniform(0.1, room), math.nan, 0.0, 0.05, 31.0, -math.inf))
            data = scan(trace.now, -math.pi, 2 * math.pi / rays, 0.1, 30, ranges)
            source.hear(3, trace.now)
            trace.observe("by", data, 3, (room, ranges[ranges != room]))
            continue
        direction = chance.choice((0.0, 0.0, math.pi / 2, -math.pi / 2, math.pi, chance.uniform(-3, 3)))
        speed = chance.choice((0.05, 0.3, 1.0, 3.0))
        legs = straight(speed, direction)
        got = trace.command(legs)
        assert got is not None
        passed = norm(got[:3])
        assert passed <= speed * (1 + 1e-9), trace.said("the guard makes it faster")
        if passed > 0:
            assert trace.now - source.heard <= silent, trace.said("the scanner is silent")
            off = np.abs((angles - direction + math.pi) % (2 * math.pi) - math.pi)
            ways = (
                (off < math.pi / 2) & (ranges * np.sin(off) < width - 1e-6) & (ranges >= 0.1) & (ranges <= 30)
            )
            blind = (off < 0.05) & ~((ranges >= 0.1) & (ranges <= 30))
            near_by = min([*ranges[ways], *([0.0] if blind.any() else []), 30.0])
            age = (trace.now - source.heard) / 1000
            most = _separated(float(near_by), age, reaction, braking, person, margin)
            assert passed <= most + 1e-4, trace.said(f"{passed} m/s, and {near_by} m permit {most}")
        fastest = max(fastest, passed)
        if len(ranges) and (ranges == ranges[0]).all() and trace.now - source.heard < silent:
            age = silent / 1000 + 0.02
            ahead = math.sqrt(max(0.0, float(ranges[0]) ** 2 - (width + 0.1) ** 2))
            most = _separated(ahead, age, reaction, braking, person, margin)
            if fastest <= passed + 1e-9 or fastest <= most:
                assert passed >= min(speed, most) - 1e-3, trace.said(
                    f"{passed} m/s, and the room permits {most}"
                )
