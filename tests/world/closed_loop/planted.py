"""Faults in the texts of guards and in the base, each of which the worlds must find.

To plant one, add a row: its name, the law that it breaks, the preset, and a function from text to text, or a class
of the world whose base is faulty. A fault that no longer changes the text of its preset also fails.

python -m tests.world.closed_loop.planted [WORD]   print the first seed that finds each fault, or those with this word
"""

import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from tests.world.closed_loop.guard_run import Change
from tests.world.closed_loop.worlds import run_one

WITHIN = 300
"""The number of worlds in which each fault must be found."""


@dataclass(frozen=True)
class Fault:
    law: str
    """The law that it breaks; a world may find it by another one first."""
    preset: str
    change: Change

    def first(self, within: int = WITHIN) -> tuple[int, str] | None:
        """Return the first seed that finds the fault, and what happened there."""
        for seed in range(within):
            report = run_one(self.preset, seed, self.change)
            if report.violations:
                return seed, str(report.violations[0])
        return None


def replaced(old: str, new: str, *, count: int = 0) -> Change:
    """Replace a regular expression, which must occur."""

    def change(text: str) -> str:
        changed, number = re.subn(old, new, text, count=count)
        if not number or changed == text:
            raise ValueError(f"the text has no {old!r} any more: plant this fault in another way")
        return changed

    return change


def _body(statements: str) -> Change:
    def change(text: str) -> str:
        head, brace, rest = text.partition("\n} {\n")
        kind = re.search(r"event \w+\([^)]*\) command\s+(\S+)", rest)
        assert brace and kind is not None
        return f"{head}{brace}{statements.replace('TYPE', kind[1])}\n}}\n"

    return change


no_guard = _body("event drive() command TYPE '{}' { }")
"""A guard that does nothing."""
stops_everything = _body("safe TYPE { } on command every 100ms;\nevent drive() command TYPE '{}' { STOP; }")

FAULTS: Mapping[str, Fault] = {}


def main(words: list[str], write: Callable[[str], object] = sys.stdout.write) -> None:
    for name, fault in FAULTS.items():
        if all(word in f"{fault.preset} {fault.law} {name}" for word in words):
            found = fault.first()
            what = "NOT FOUND" if found is None else f"seed {found[0]}: {found[1]}"
            write(f"{fault.preset} {fault.law} {name}: {what}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
