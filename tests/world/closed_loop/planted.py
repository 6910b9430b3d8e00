"""Faults in the texts of guards, in the engine and in the base, each of which the worlds must find.

To plant one, add a row: its name, the law that it breaks, the preset, and a function from text to text, or an attribute
of the engine or of the base with its replacement. A fault that no longer changes the text of its preset also fails.

python -m tests.world.closed_loop.planted [WORD]   print the first seed that finds each fault, or those with this word
"""

import contextlib
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any
from unittest import mock

from tests.support.features.guards.running_guard import Change, unchanged
from tests.world.closed_loop.bases import Base
from tests.world.closed_loop.guard_run import RunningGuard
from tests.world.closed_loop.messages import Legs
from tests.world.closed_loop.worlds import run_one

WITHIN = 300
"""The number of worlds in which each fault must be found."""


@dataclass(frozen=True)
class Fault:
    law: str
    """The law that it breaks; a world may find it by another one first."""
    preset: str
    change: Change = unchanged
    patch: tuple[Any, str, Any] | None = None
    """An object, its attribute, and the replacement."""

    def first(self, within: int = WITHIN) -> tuple[int, str] | None:
        """Return the first seed that finds the fault, and what happened there; without the fault nothing does."""
        for seed in range(within):
            with mock.patch.object(*self.patch) if self.patch else contextlib.nullcontext():
                report = run_one(self.preset, seed, self.change)
            if report.violations and not run_one(self.preset, seed).violations:
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


def _forgetful(guard: RunningGuard) -> None:
    guard.restart(guard.now, lost=True)
    resume_guard(guard)


def _deaf(guard: RunningGuard, topic: str, data: bytes, at: int, node: int) -> Any:
    if guard.holds and topic != guard.topics["command"]:
        return None, []
    return _tell(guard, topic, data, at, node)


def _blind(guard: RunningGuard, topic: str, data: bytes, at: int, node: int) -> Any:
    if guard.holds and topic != guard.topics["command"]:
        return data, []
    return _tell(guard, topic, data, at, node)


def _left_as_it_was(guard: RunningGuard, at: int, *, lost: bool) -> None:
    _restart(guard, at, lost=lost)
    guard.stand_by()


def _slow(base: Base, legs: Legs) -> tuple[float, float, float]:
    base.braking = base.full_braking / 2
    return _wanted(base, legs)


def _late(base: Base, at: int, legs: Legs) -> None:
    base.orders.append((at + 3 * base.lag + 150, legs))


resume_guard, _tell, _restart, _wanted = (
    RunningGuard.resume,
    RunningGuard.tell,
    RunningGuard.restart,
    Base.wanted_by,
)

FAULTS: Mapping[str, Fault] = {
    # L1
    "speed limits the x axis alone": Fault(
        "L1", "speed", replaced(r"sqrt\(x \* x \+ y \* y \+ z \* z\)", "fabs(x)")
    ),
    "speed clips each axis": Fault(
        "L1",
        "speed",
        replaced(
            r"x \*= straight; y \*= straight; z \*= straight;",
            "x = clamp(x, -vMax, vMax); y = clamp(y, -vMax, vMax); z = clamp(z, -vMax, vMax);",
        ),
    ),
    "speed does not limit the growth": Fault("L1", "speed", replaced(r"\baMax \* passed", "vMax")),
    "separation shortens x alone": Fault(
        "L1", "separation", replaced(r"x \*= part; y \*= part; z \*= part;", "x *= part;")
    ),
    "separation counts x alone": Fault(
        "L1",
        "separation",
        replaced(r"double v = sqrt\(x \* x \+ y \* y \+ z \* z\)", "double v = fabs(x)"),
    ),
    "sane does not judge the steering": Fault("L1", "sane", replaced(r"!isfinite\(steer\)", "false")),
    # L2
    "separation takes invalid ranges for far ones": Fault(
        "L2", "separation", replaced(r"r < low && r != 0 \? 0 : -1", "far")
    ),
    "separation takes NaN for far": Fault("L2", "separation", replaced(r"\? 0 : -1;", "? 0 : far;")),
    "separation does not ask whether rays cover its way": Fault(
        "L2", "separation", replaced(r"!covers\(from, to\)", "false")
    ),
    "sensor takes a blind scan": Fault(
        "L2", "sensor", replaced(r"valid > 0 && valid >= least \* values.size\(\)", "true")
    ),
    "sensor takes frozen values": Fault("L2", "sensor", replaced(r"repeated < frozen", "true")),
    "arm takes any charge for enough": Fault(
        "L2", "arm", replaced(r"left >= charge && left <= 1", "!(left < charge)")
    ),
    "agree compares the linear velocity alone": Fault("L2", "agree", replaced(r"&& turned <= turning", "")),
    "fence takes any quaternion for a heading": Fault(
        "L2", "fence", replaced(r"fabs\(norm - 1\) <= 0.1 \?", "true ?")
    ),
    # L3
    "separation forgets the age of the scan": Fault(
        "L3", "separation", replaced(r"double delay = reaction \+ 0.02;", "double delay = 0;")
    ),
    "separation forgets the person": Fault("L3", "separation", replaced(r"person \* \(", "0 * (")),
    "separation judges no scan": Fault("L3", "separation", replaced(r"if \(lastV > 0\) \{", "if (false) {")),
    "separation judges no tick": Fault("L3", "separation", replaced(r"if \(lastV > 0 &&", "if (false &&")),
    "fence forgets how long the base needs": Fault("L3", "fence", replaced(r"\bahead\b(?! =)", "0.0")),
    "fence forgets its margin": Fault(
        "L3", "fence", replaced(r"part \* swing \+ stray", "-1 + 0 * (swing + stray)")
    ),
    "deadman never ends a motion": Fault(
        "L3", "deadman", replaced(r"if \(stopped && pause == 0\)", "if (false)")
    ),
    "deadman waits twice as long": Fault("L3", "deadman", replaced(r"At <= silent", "At <= 2 * silent")),
    "rate drops slower commands": Fault("L3", "rate", replaced(r"&& !slower", "")),
    "the base of separation brakes at half of what it declares": Fault(
        "L3", "separation", patch=(Base, "wanted_by", _slow)
    ),
    "the base of fence is later than it declares": Fault("L3", "fence", patch=(Base, "order", _late)),
    # L4
    "estop has one button": Fault("L4", "estop", replaced(r"node = caller\(button\)", 'node = "a button"')),
    "estop has one hand": Fault("L4", "estop", replaced(r"node = caller\(again\)", 'node = "a hand"')),
    "estop counts a hand twice": Fault("L4", "estop", replaced(r"&& i != place", "")),
    "estop hears any button": Fault(
        "L4", "estop", replaced(r"!\(now - heard\[i\] <= silent\)", "!(now - heard[0] <= silent)")
    ),
    "deadman knows one node": Fault(
        "L4", "deadman", replaced(r'caller\(drive\) == "" \? "a node" : caller\(drive\)', '"a node"')
    ),
    "sensor takes another node for its sensor": Fault(
        "L4", "sensor", replaced(r"caller\(sense\) == source", "true")
    ),
    "arm takes another battery for its own": Fault(
        "L4", "arm", replaced(r"caller\(battery\) == batteryNode", "true")
    ),
    # L5
    "estop begins anew after its state is lost": Fault(
        "L5", "estop", replaced(r"(?m)^estop\(|^guard\(", "begin guard(")
    ),
    "a hold drops observed messages": Fault("L5", "estop", patch=(RunningGuard, "tell", _deaf)),
    "a hold of a fence drops observed messages": Fault("L5", "fence", patch=(RunningGuard, "tell", _deaf)),
    "a guard hears nothing while it holds": Fault("L5", "estop", patch=(RunningGuard, "tell", _blind)),
    "a guard forgets its state when it is resumed": Fault(
        "L5", "estop", patch=(RunningGuard, "resume", _forgetful)
    ),
    "a hold holds nothing": Fault("L5", "deadman", patch=(RunningGuard, "hold", lambda _guard: None)),
    # L6
    "deadman takes the first command after a silence": Fault("L6", "deadman", replaced(r">= resume", ">= 0")),
    "estop needs no zero": Fault("L6", "estop", replaced(r"zeroFirst\)", "false)")),
    "estop takes the zero of any node": Fault(
        "L6", "estop", replaced(r"standing == node \|\| standingToo == node", 'standing != ""')
    ),
    "estop takes a zero from before the stop": Fault(
        "L6", "estop", replaced(r"if \(!released \|\| latched\)", "if (false)")
    ),
    "estop takes a key that is stuck": Fault(
        "L6",
        "estop",
        replaced(r"(pressed) && down\[place\] == 0|(latched && released) && moved.*?0\.1", r"\1\2"),
    ),
    "a restarted guard sends no stop": Fault("L6", "speed", patch=(RunningGuard, "restart", _left_as_it_was)),
}
"""The first of each law; a fault of a law is found by a violation of any law."""


def main(words: list[str], write: Callable[[str], object] = sys.stdout.write) -> None:
    for name, fault in FAULTS.items():
        if all(word in f"{fault.preset} {fault.law} {name}" for word in words):
            try:
                found = fault.first()
            except ValueError as error:
                write(f"{fault.preset} {fault.law} {name}: {error}\n")
                continue
            what = "NOT FOUND" if found is None else f"seed {found[0]}: {found[1]}"
            write(f"{fault.preset} {fault.law} {name}: {what}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
