"""Order the specifications of a set by their phases and by `order` statements.

Without them they keep the order of the text. A phase or statement moves a specification after those that come before
it, no further than necessary.
"""

from collections.abc import Iterator, Sequence
from heapq import heappop, heappush

from rosmop.form.findings import Diagnostic, SpecificationError
from rosmop.text import tree
from rosmop.types.messages import nearest, shown

Phases = frozenset[tuple[str, str]]

NAMED = ("stops", "drops", "limits", "watches", "smooths", "follows")
"""The phases of specifications that have one (`name() in limits { … }`), in their order."""


def phases_of(
    orders: Sequence[tree.OrderStatement], specifications: Sequence[tree.Specification] = ()
) -> Phases:
    """Return all pairs that phases and statements order. Raises `SpecificationError` for a cycle."""
    behind: dict[str, set[str]] = {}
    placed = [(one.name, _place(one.phase)) for one in specifications if one.phase is not None]
    for first, place in placed:
        behind[first] = {second for second, other in placed if place < other}
    for order in orders:
        names = [name.parts[0] for name in order.names]
        for place, name in enumerate(names):
            behind.setdefault(name, set()).update(names[place + 1 :])
    pairs = frozenset((first, second) for first in behind for second in _reached(behind, first))
    for order in orders:
        for word in order.names:
            if (word.parts[0], word.parts[0]) in pairs:
                text = f"{shown(word.parts[0])} would come before itself; leave out an `order` statement or a phase"
                raise SpecificationError.at(word.position, text)
    return pairs


def _place(phase: tree.Name) -> int:
    name = phase.parts[0]
    if name not in NAMED:
        text = f"there is no phase {shown(name)}{nearest(name, NAMED)}; there are {', '.join(NAMED)}"
        raise SpecificationError.at(phase.position, text)
    return NAMED.index(name)


def _reached(behind: dict[str, set[str]], name: str) -> set[str]:
    found: set[str] = set()
    waiting = [name]
    while waiting:
        further = behind.get(waiting.pop(), set()) - found
        found |= further
        waiting += further
    return found


def ordered(names: Sequence[str], phases: Phases) -> list[int]:
    places: dict[str, list[int]] = {}
    for place, name in enumerate(names):
        places.setdefault(name, []).append(place)
    behind: dict[int, list[int]] = {}
    waits = [0] * len(names)
    for first, second in phases:
        for place in places.get(first, ()):
            behind.setdefault(place, []).extend(places.get(second, ()))
        for place in places.get(second, ()):
            waits[place] += len(places.get(first, ()))
    ready = [place for place, number in enumerate(waits) if not number]  # in ascending order, so it is a heap
    found = []
    while ready:
        found.append(heappop(ready))
        for place in behind.get(found[-1], ()):
            waits[place] -= 1
            if not waits[place]:
                heappush(ready, place)
    return found


def unknown_phases(orders: Sequence[tree.OrderStatement], names: Sequence[str]) -> Iterator[Diagnostic]:
    for order in orders:
        for name in order.names:
            if name.parts[0] not in names:
                text = f"no specification is named {shown(name.parts[0])}{nearest(name.parts[0], names)}"
                yield Diagnostic(
                    name.position, "warning", f"{text}; `order` has no effect on it until one is loaded"
                )
