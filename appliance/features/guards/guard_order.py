"""The pairs of presets whose order on a topic changes what they promise.

The phases of the presets keep each row. Guards of releases before 0.4 have no phase, and see messages in the order of
their files: until 0.5, a new guard gets an `order` statement for each of them on its topic.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple


class Precedence(NamedTuple):
    """Each preset of `first` acts before each of `then`; `otherwise`: what happens in the other order."""

    first: tuple[str, ...]
    then: tuple[str, ...]
    otherwise: str


PRECEDENCES = (
    Precedence(
        (
            "agree",
            "arm",
            "deadman",
            "enable",
            "estop",
            "fence",
            "mode",
            "overspeed",
            "sensor",
            "separation",
            "standstill",
            "zone",
        ),
        ("speed",),
        "after a stop the base jumps to its full velocity, as if it had driven on",
    ),
    Precedence(
        (
            "agree",
            "arm",
            "deadman",
            "enable",
            "estop",
            "fence",
            "mode",
            "overspeed",
            "sane",
            "sensor",
            "separation",
            "zone",
        ),
        ("standstill",),
        "a base that moves after a stop by the other guard is not noticed",
    ),
    Precedence(
        ("sane",),
        ("mode", "separation", "speed", "zone"),
        "of a command with an infinite velocity, the other velocities pass",
    ),
    Precedence(
        ("rate",),
        ("fence", "mode", "separation", "speed", "standstill", "zone"),
        "a dropped command counts as the motion in force, so the real one is not stopped or limited",
    ),
    Precedence(("deadman",), ("rate",), "dropped commands count as silence and stop the base"),
    Precedence(
        ("arm", "sane"), ("rate",), "a command that has to be stopped may be dropped, and the base drives on"
    ),
    Precedence(
        ("arm", "enable", "estop", "joints", "sensor"),
        ("answer",),
        "a goal that was dropped is reported as late, and cancelled, after the deadline",
    ),
)


@dataclass(frozen=True)
class Placed:
    """A guard on the topic that it commands; `file` is its specification file."""

    name: str
    preset: str
    command: str
    file: str
    phased: bool = True
    """Whether it has the phase of its preset, unlike guards of releases before 0.4."""


def _closure() -> frozenset[tuple[str, str]]:
    pairs = {(first, then) for row in PRECEDENCES for first in row.first for then in row.then}
    while further := {(one, last) for one, to in pairs for by, last in pairs if to == by} - pairs:
        pairs |= further
    return frozenset(pairs)


_BEFORE = _closure()
"""The pairs of presets that the rows order, also through a third one."""


def statements(new: Placed, loaded: Iterable[Placed]) -> str:
    """Return the `order` statements to append to the source of a new guard.

    The order of files is not enough, because a phase may move a guard, even for a guard of another topic.
    """
    pairs = [pair for other in loaded if not other.phased for pair in ((other, new), (new, other))]
    return "".join(
        f"\norder {first.name} < {then.name};\n"
        for first, then in pairs
        if first.command == then.command and (first.preset, then.preset) in _BEFORE
    )


def faults(guards: Sequence[Placed]) -> Iterator[str]:
    """Yield the pairs that act in the wrong order, with the remedy; `guards` are in the order in which they act."""
    for place, first in enumerate(guards):
        for second in guards[place + 1 :]:
            if why := _broken(first, second):
                yield (
                    f"{first.name} acts before {second.name}: {why}; write order {second.name} < {first.name}; into"
                    f" {first.file}, and load it with rosrv monitor load"
                )


def _broken(first: Placed, second: Placed) -> str:
    """Return what happens if `first` acts before `second`, or nothing if this order is right."""
    if first.command != second.command or (first.phased and second.phased):
        return ""
    rows = (one.otherwise for one in PRECEDENCES if second.preset in one.first and first.preset in one.then)
    return next(rows, "")
