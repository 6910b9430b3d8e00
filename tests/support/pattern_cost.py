"""Bound the steps of a regular expression by its construction, without running it.

Python's matcher returns to each repeat and branch to try its other alternatives, and holds the interpreter lock in
that time. A possessive repeat (`*+`, `++`) of one set of characters has one alternative, so it only scans the input.
"""

import math
from re import _constants as op  # the parse tree has no public form
from re import _parser
from typing import Any

_SHORT = 64  # an attempt of so few steps counts as part of the scan for the next match
_SETS = {op.LITERAL, op.NOT_LITERAL, op.ANY, op.IN}
_ONE_WAY = {op.ATOMIC_GROUP, op.ASSERT, op.ASSERT_NOT}
_LOOPS = {op.MAX_REPEAT, op.MIN_REPEAT, op.POSSESSIVE_REPEAT}


def steps(pattern: str | bytes, flags: int, size: int, *, anywhere: bool) -> float:
    """Return a bound of the steps for an input of `size`. With `anywhere`, each position is an attempt.

    In an attempt that can fail after a scan, the scan counts with its length.
    """
    text = pattern.decode("latin-1") if isinstance(pattern, bytes) else pattern
    tree = list(_parser.parse(text, 0 if isinstance(pattern, bytes) else flags))
    if not anywhere:
        return _sequence(tree, size, 1)[1]
    last_cannot_fail = _is_scan(tree[-1])
    cost = _sequence(tree[:-1] if last_cannot_fail else tree, size, size)[1]
    return cost * size if cost > _SHORT else cost


def _is_scan(node: Any) -> bool:
    kind, value = node
    return kind is op.POSSESSIVE_REPEAT and len(value[2]) == 1 and value[2][0][0] in _SETS


def _sequence(nodes: Any, size: int, scan: int) -> tuple[float, float]:
    ways, cost = 1.0, 0.0
    for node in nodes:
        its_ways, its_cost = _node(node, size, scan)
        cost += ways * its_cost
        ways *= its_ways
    return ways, max(cost, 1.0)


def _node(node: Any, size: int, scan: int) -> tuple[float, float]:
    kind, value = node
    if _is_scan(node):
        return 1.0, min(scan, value[1])
    if kind is op.SUBPATTERN:
        return _sequence(value[3], size, scan)
    if kind is op.BRANCH:
        found = [_sequence(one, size, scan) for one in value[1]]
        return sum(ways for ways, _ in found), sum(cost for _, cost in found)
    if kind in _ONE_WAY:
        return 1.0, _sequence(value if kind is op.ATOMIC_GROUP else value[1], size, scan)[1]
    return _repeat(kind, value, size, scan) if kind in _LOOPS else (1.0, 1.0)


def _repeat(kind: Any, value: Any, size: int, scan: int) -> tuple[float, float]:
    least, most, body = value
    ways, cost = _sequence(body, size, scan)
    times = max(least, min(most, size // max(1, body.getwidth()[0])))
    if kind is op.POSSESSIVE_REPEAT:
        return 1.0, math.inf  # Python 3.11 matches wrongly, unless it repeats one set (gh-106052)
    if ways == 1:
        return times - least + 1.0, times * cost
    if times * math.log10(ways) > 30:
        return math.inf, math.inf
    return sum(ways**count for count in range(least, times + 1)), cost * sum(
        ways**count for count in range(times)
    )
