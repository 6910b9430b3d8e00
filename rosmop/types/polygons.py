"""Check that the corners of a fence enclose one area: with crossing edges, a part inside would count as outside."""

from collections.abc import Sequence
from itertools import combinations, pairwise

Corner = tuple[float, float]


def fault_of(corners: Sequence[Corner]) -> str:
    edges = [edge for edge in pairwise([*corners, corners[0]]) if edge[0] != edge[1]]
    if not edges or all(_turn(*edges[0], corner) == 0 for corner in corners):
        return "the corners are on one line"
    if any(_cross(*one, *other) for one, other in combinations(edges, 2)):
        return "edges cross"
    return ""


def _turn(a: Corner, b: Corner, c: Corner) -> int:
    """Return 1 if `c` is to the left of the line from `a` to `b`, -1 if it is to the right, 0 if it is on it."""
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    return (area > 0) - (area < 0)


def _cross(a: Corner, b: Corner, c: Corner, d: Corner) -> bool:
    """Return whether two edges cross. Edges that only touch, as neighbours do, do not cross."""
    return _turn(a, b, c) * _turn(a, b, d) < 0 and _turn(c, d, a) * _turn(c, d, b) < 0
