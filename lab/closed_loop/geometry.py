"""Exact distances in the plane, in metres, and the ranges of a scanner."""

import math
from collections.abc import Sequence

import numpy as np

Point = tuple[float, float]
Segment = tuple[float, float, float, float]
"""The ends of a straight wall: x, y, x, y."""


def nearest_on(segment: Segment, x: float, y: float) -> Point:
    ax, ay, bx, by = segment
    dx, dy = bx - ax, by - ay
    square = dx * dx + dy * dy
    part = 0.0 if square == 0 else max(0.0, min(1.0, ((x - ax) * dx + (y - ay) * dy) / square))
    return ax + part * dx, ay + part * dy


def apart(one: Segment, other: Segment) -> float:
    """Return the distance between two segments."""
    ax, ay, bx, by = one
    cx, cy, dx, dy = other
    sides = [(px - ax) * (by - ay) - (py - ay) * (bx - ax) for px, py in ((cx, cy), (dx, dy))]
    others = [(px - cx) * (dy - cy) - (py - cy) * (dx - cx) for px, py in ((ax, ay), (bx, by))]
    if sides[0] * sides[1] < 0 and others[0] * others[1] < 0:
        return 0.0
    ends = [((ax, ay), other), ((bx, by), other), ((cx, cy), one), ((dx, dy), one)]
    return min(math.dist(end, nearest_on(segment, *end)) for end, segment in ends)


def edges(corners: Sequence[Point]) -> list[Segment]:
    return [(*corner, *other) for corner, other in zip(corners, [*corners[1:], corners[0]], strict=True)]


def is_inside(corners: Sequence[Point], x: float, y: float) -> bool:
    found = False
    for ax, ay, bx, by in edges(corners):
        if (ay > y) != (by > y) and x < ax + (y - ay) * (bx - ax) / (by - ay):
            found = not found
    return found


def are_inside(corners: Sequence[Point], x: "np.ndarray", y: "np.ndarray", margin: float) -> "np.ndarray":
    """Return which points are inside a polygon, `margin` away from its edge."""
    found, apart = np.zeros(x.shape, bool), np.full(x.shape, np.inf)
    for ax, ay, bx, by in edges(corners):
        dx, dy = bx - ax, by - ay
        part = np.clip(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy), 0, 1)
        apart = np.minimum(apart, np.hypot(x - ax - part * dx, y - ay - part * dy))
        if dy:
            found ^= ((ay > y) != (by > y)) & (x < ax + (y - ay) * dx / dy)
    return found & (apart > margin)


def depth(corners: Sequence[Point], x: float, y: float) -> float:
    """Return the distance to the edge of a polygon, negative outside of it."""
    least = min(math.dist((x, y), nearest_on(edge, x, y)) for edge in edges(corners))
    return least if is_inside(corners, x, y) else -least


def ranges(
    x: float,
    y: float,
    angles: "np.ndarray",
    walls: Sequence[Segment],
    discs: Sequence[tuple[float, float, float]],
) -> "np.ndarray":
    """Return the distance from a point to the first wall or disc (x, y, radius) at each angle, or infinity."""
    cos, sin = np.cos(angles), np.sin(angles)
    found = np.full(angles.shape, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for ax, ay, bx, by in walls:
            ex, ey = bx - ax, by - ay
            across = cos * ey - sin * ex
            along = ((ax - x) * ey - (ay - y) * ex) / across
            part = ((ax - x) * sin - (ay - y) * cos) / across
            hit = (across != 0) & (along >= 0) & (part >= 0) & (part <= 1)
            found = np.where(hit & (along < found), along, found)
        for px, py, radius in discs:
            middle = cos * (px - x) + sin * (py - y)
            beside = (px - x) ** 2 + (py - y) ** 2 - middle**2
            along = middle - np.sqrt(radius**2 - beside)
            found = np.where((along >= 0) & (along < found), along, found)
    return found
