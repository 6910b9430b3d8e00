"""Faults in the texts of guards, in the engine and in the base, each of which the worlds must find.

To plant one, add a row: its name, the law that it breaks, the preset, and a function from text to text, or an attribute
of the engine or of the base with its replacement. A fault that no longer changes the text of its preset also fails.

python -m lab.closed_loop.planted [WORD]   print the first seed that finds each fault, or those with this word
"""

import contextlib
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from unittest import mock

from lab.closed_loop.bases import Base
from lab.closed_loop.guard_run import RunningGuard
from lab.closed_loop.messages import Legs
from lab.closed_loop.worlds import run_one
from rosmop.run.origins import Origin
from tests.support.features.guards.running_guard import Change, unchanged

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


def edit(old: str, new: str, *, count: int = 0) -> Change:
    """Replace a regular expression, which must occur."""

    def change(text: str) -> str:
        changed, number = re.subn(old, new, text, count=count)
        if not number or changed == text:
            raise ValueError(f"the text has no {old!r} any more: plant this fault in another way")
        return changed

    return change


def _body(statements: str) -> Change:
    def change(text: str) -> str:
        head, brace, _rest = text.partition("\n} {\n")
        assert brace
        return f"{head}{brace}{statements}\n}}\n"

    return change


no_guard = _body("event drive() command { }")
"""A guard that does nothing."""
stops_everything = _body("safe { } on command every 100ms;\nevent drive() command { STOP; }")


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


def _hears_any(origin: Origin, _node: str) -> bool:
    origin.first = None
    return True


resume_guard, _tell, _restart, _wanted = (
    RunningGuard.resume,
    RunningGuard.tell,
    RunningGuard.restart,
    Base.wanted_by,
)

FAULTS: Mapping[str, Fault] = {
    # L1
    "speed limits the x axis alone": Fault(
        "L1", "speed", edit(r"sqrt\(x \* x \+ y \* y \+ z \* z\)", "fabs(x)")
    ),
    "speed clips each axis": Fault(
        "L1",
        "speed",
        edit(
            r"x \*= straight; y \*= straight; z \*= straight;",
            "x = clamp(x, -vMax, vMax); y = clamp(y, -vMax, vMax); z = clamp(z, -vMax, vMax);",
        ),
    ),
    "speed does not limit the growth": Fault("L1", "speed", edit(r"\baMax \* passed", "vMax")),
    "separation shortens x alone": Fault(
        "L1", "separation", edit(r"x \*= part; y \*= part; z \*= part;", "x *= part;")
    ),
    "separation counts x alone": Fault(
        "L1",
        "separation",
        edit(r"double v = sqrt\(x \* x \+ y \* y \+ z \* z\)", "double v = fabs(x)"),
    ),
    "sane does not judge the steering": Fault("L1", "sane", edit(r"!isfinite\(steer\)", "false")),
    # L2
    "separation takes invalid ranges for far ones": Fault(
        "L2", "separation", edit(r"r < low && r != 0 \? 0 : -1", "far")
    ),
    "separation takes NaN for far": Fault("L2", "separation", edit(r"\? 0 : -1;", "? 0 : far;")),
    "separation does not ask whether rays cover its way": Fault(
        "L2", "separation", edit(r"&& covers\(from, to\)", "")
    ),
    "sensor takes a blind scan": Fault(
        "L2", "sensor", edit(r"valid > 0 && valid >= least \* values.size\(\)", "true")
    ),
    "sensor takes frozen values": Fault("L2", "sensor", edit(r"repeated < frozen", "true")),
    "arm takes any charge for enough": Fault(
        "L2", "ready", edit(r"left >= charge && left <= most", "!(left < charge)")
    ),
    "agree compares the linear velocity alone": Fault("L2", "agree", edit(r"&& turned <= turning", "")),
    "fence takes any quaternion for a heading": Fault(
        "L2", "fence", edit(r"fabs\(norm - 1\) <= 0.1 \?", "true ?")
    ),
    # L3
    "separation forgets the age of the scan": Fault(
        "L3", "separation", edit(r"double delay = reaction \+ 0.02;", "double delay = 0;")
    ),
    "separation forgets the person": Fault("L3", "separation", edit(r"person \* \(", "0 * (")),
    "separation judges no scan": Fault("L3", "separation", edit(r"if \(lastV > 0\) \{", "if (false) {")),
    "separation judges no tick": Fault("L3", "separation", edit(r"if \(lastV > 0 &&", "if (false &&")),
    "fence forgets how long the base needs": Fault("L3", "fence", edit(r"\bahead\b(?! =)", "0.0")),
    "fence forgets its margin": Fault(
        "L3", "fence", edit(r"fmax\(margin \+ part \* swing \+ stray, between\)", "-1")
    ),
    "deadman never ends a motion": Fault(
        "L3", "deadman", edit(r"if \(stopped && pause == 0\)", "if (false)")
    ),
    "deadman waits twice as long": Fault("L3", "deadman", edit(r"At <= silent", "At <= 2 * silent")),
    "rate drops slower commands": Fault("L3", "rate", edit(r"&& !slower", "")),
    "the base of separation brakes at half of what it declares": Fault(
        "L3", "separation", patch=(Base, "wanted_by", _slow)
    ),
    "the base of fence is later than it declares": Fault("L3", "fence", patch=(Base, "order", _late)),
    # L4
    "estop has one button": Fault(
        "L4", "estop", edit(r"index\(buttons, caller\(button\)\)", "buttons.size() - 1")
    ),
    "estop has one hand": Fault("L4", "estop", edit(r"index\(hands, caller\(again\)\)", "hands.size() - 1")),
    "estop counts a hand twice": Fault("L4", "estop", edit(r"&& i != place", "")),
    "estop hears any button": Fault(
        "L4", "estop", edit(r"!\(now - heard\[i\] <= silent\)", "!(now - heard[0] <= silent)")
    ),
    "deadman knows one node": Fault(
        "L4", "deadman", edit(r'caller\(drive\) == "" \? "a node" : caller\(drive\)', '"a node"')
    ),
    "sensor takes another node for its sensor": Fault(
        "L4", "sensor", edit(r"caller\(sense\) == source", "true")
    ),
    "arm takes another battery for its own": Fault(
        "L4", "ready", edit(r"caller\(battery\) == batteryNode", "true")
    ),
    # L5
    "estop begins anew after its state is lost": Fault("L5", "estop", edit(r"(?m)^estop\(", "begin estop(")),
    "a hold drops observed messages": Fault("L5", "estop", patch=(RunningGuard, "tell", _deaf)),
    "a hold of a fence drops observed messages": Fault("L5", "fence", patch=(RunningGuard, "tell", _deaf)),
    "a guard hears nothing while it holds": Fault("L5", "estop", patch=(RunningGuard, "tell", _blind)),
    "a guard forgets its state when it is resumed": Fault(
        "L5", "estop", patch=(RunningGuard, "resume", _forgetful)
    ),
    "a hold holds nothing": Fault("L5", "deadman", patch=(RunningGuard, "hold", lambda _guard: None)),
    # L6
    "deadman takes the first command after a silence": Fault("L6", "deadman", edit(r">= resume", ">= 0")),
    "estop needs no zero": Fault("L6", "estop", edit(r"zeroFirst\)", "false)")),
    "estop takes the zero of any node": Fault(
        "L6", "estop", edit(r"standing == one \|\| standingToo == one", 'standing != ""')
    ),
    "estop takes a zero from before the stop": Fault(
        "L6", "estop", edit(r"if \(!released \|\| latched\)", "if (false)")
    ),
    "estop takes a key that is stuck": Fault(
        "L6",
        "estop",
        edit(r"(pressed) && down\[place\] == 0|(latched && released) && moved.*?0\.1", r"\1\2"),
    ),
    "a restarted guard sends no stop": Fault("L6", "speed", patch=(RunningGuard, "restart", _left_as_it_was)),
}
"""The first of each law; a fault of a law is found by a violation of any law."""

_ROWS: Sequence[tuple[str, str, str, str, str]] = (
    # law, preset, what is wrong, a regular expression, its replacement
    ("L1", "mode", "limits the x axis alone", r"sqrt\(x \* x \+ y \* y \+ z \* z\)", "fabs(x)"),
    ("L1", "mode", "limits no turn", r"w <= wMax \? 1 :", "true ? 1 :"),
    ("L1", "mode", "shortens x alone", r"x \*= straight; y \*= straight; z \*= straight;", "x *= straight;"),
    ("L1", "mode", "limits no linear velocity", r"v <= vMax \? 1 :", "true ? 1 :"),
    ("L1", "speed", "limits no turn", r"share\(w, [^;]*;", "1;"),
    ("L1", "speed", "turns about z alone", r"sqrt\(rx \* rx \+ ry \* ry \+ rz \* rz\)", "fabs(rz)"),
    ("L1", "speed", "lets a turn grow at once", r"alphaMax \* passed", "wMax"),
    ("L1", "speed", "lets the velocity grow from any direction",
     r"\(x \* lastX \+ y \* lastY \+ z \* lastZ\) / v", "vMax"),
    ("L1", "zone", "limits the x axis alone", r"sqrt\(x \* x \+ y \* y \+ z \* z\)", "fabs(x)"),
    ("L1", "fence", "counts x alone", r"double v = sqrt\(x \* x \+ y \* y\)", "double v = fabs(x)"),
    ("L1", "fence", "shortens x alone", r"x \*= part; y \*= part;", "x *= part;"),
    ("L1", "joints", "has no limits", r"good = clamp\(q, least, most\) == q &&", "good ="),
    ("L1", "joints", "limits no velocity between points", r"fabs\(q - p\) <= vMax \* t \+ rounding", "true"),
    ("L1", "joints", "limits no velocity of a point", r"fabs\(w\) <= vMax", "true"),
    ("L1", "joints", "limits no acceleration", r"fabs\(b\) <= aMax", "true"),
    ("L1", "joints", "judges the first part of a curve", r"left -= t;", "left = 0;"),
    ("L1", "joints", "limits no velocity of a curve", r"<= top \* t\)", "<= 1e9)"),
    ("L1", "joints", "takes times in any order", r"t > before\)", "true)"),
    ("L1", "joints", "takes its own clock for the controller's", r"clamp\(fmin\(clock, clockToo\)[^;]*", "0"),
    ("L1", "joints", "takes a moving joint for one at rest", r"later \? 0 : -top, up = later \? 0 : top", "0, up = 0"),
    ("L2", "hold_to_run", "hears no silence", r"now - heard\[(\w+)\] <= silent", "true"),
    ("L2", "mode", "hears no silence", r"silent > 0 && !\(now - heard\[i\] <= silent\)", "false"),
    ("L2", "diagnostics", "hears no silence", r"&& now - oldest <= silent", ""),
    ("L2", "diagnostics", "takes STALE for well", r"level != 0 && \(warnings", "level == 2 && (warnings"),
    ("L3", "diagnostics", "does not stop at a message", r"tell\(now, 0\); passed = false; STOP;", ""),
    ("L4", "diagnostics", "has one node", r'caller\(report\) == ""', "true"),
    ("L4", "diagnostics", "asks the first entry alone", r"i < levels.size\(\)", "i < 1"),
    ("L6", "diagnostics", "needs no zero", r"else if \(zeroFirst\)", "else if (false)"),
    ("L6", "diagnostics", "takes the zero of any node", r"standing == node \|\| standingToo == node", 'standing != ""'),
    ("L6", "diagnostics", "takes a zero from before the stop", r'standing = "";\s+standingToo = "";', ""),
    ("L2", "mode", "begins in automatic mode", r"manual = nodes.size\(\) == 0 .*crowded", "manual = crowded"),
    ("L2", "estop", "waits for one button alone", r"&& buttons.size\(\) >= publishers", ""),
    ("L2", "hold_to_run", "waits for one device alone", r"&& devices.size\(\) >= publishers", ""),
    ("L2", "mode", "waits for one node alone", r"\|\| nodes.size\(\) < publishers", ""),
    ("L2", "overspeed", "takes NaN for slow", r"!\(v <= vMax && w <= wMax\)", "v > vMax || w > wMax"),
    ("L2", "overspeed", "hears no silence", r"return since <= silent &&", "return"),
    ("L2", "standstill", "takes NaN for known", r"known = isfinite\(v\) && isfinite\(w\);", "known = true;"),
    ("L2", "standstill", "hears no silence", r"sinceMeasure <= silent &&", ""),
    ("L2", "zone", "hears no silence", r"!\(sinceScan <= silent\) \|\|", ""),
    ("L2", "zone", "takes NaN for free", r"blankIsFree && !\(r < 0\)", "!(r < 0)"),
    ("L2", "zone", "does not ask whether rays cover it", r"whole = covers\(\);", "whole = true;"),
    ("L2", "zone", "takes a zone behind a thing for free", r"r > far \|\| r < own", "r > far || r < 0.4"),
    ("L2", "agree", "hears no silence", r"since <= silent && sinceOther <= silent", "true"),
    ("L2", "ready", "hears no silence", r"battery <= silent &&", ""),
    ("L2", "sensor", "hears no silence", r"since <= silent &&", ""),
    ("L3", "hold_to_run", "does not stop at a release", r"if \(judge\(now\)\) \{[^}]*\}", "judge(now);"),
    ("L3", "mode", "does not stop at a change", r"if \(judge\(now\)\) \{[^}]*\}", "judge(now);"),
    ("L3", "overspeed", "does not stop at a measurement", r"(?s)(fast = true;\s*passed = false;\s*)STOP;", r"\1"),
    ("L3", "standstill", "waits twice as long", r"now - since <= settle", "now - since <= 2 * settle"),
    ("L3", "standstill", "stops once", r"pause == 0 && !slow && age\(measure\) <= silent", "false"),
    ("L3", "zone", "judges no tick", r"(lastV = 0;\s+lastW = 0;\s+)STOP;", r"\1"),
    ("L3", "joints", "permits any jump", r"double free = jump -", "double free = 100 -"),
    ("L3", "joints", "grants a jump with each point", r"fmax\(gained\w*\[i\] \+ way - grown\w*, 0\) : 0", "0 : 0"),
    ("L3", "joints", "stops again within a stop", r"if \(now < stopped\) \{\s*if \(good\)[^}]*\}[^}]*\} else if", "if"),
    ("L3", "joints", "stops again after a trajectory", r"stopped = fmax\(stopped, bridged\)", "stopped = bridged"),
    ("L3", "joints", "does not ask where the arm is", r" && fabs\(found\[place\] - starts\[k\]\) <= jump / 2", ""),
    ("L3", "joints", "takes a dropped goal for a stop", r"othersEnd = fmax\(othersEnd, good \? 0 : before\);", ""),
    ("L3", "fence", "judges no tick", r"lastV > 0 && \(!\(age\(pose\)", "false && (!(age(pose)"),
    ("L3", "rate", "drops a stop", r"if \(moves && !slower &&", "if (!slower &&"),
    ("L4", "hold_to_run", "has one device", r"index\(devices, caller\(device\)\)", "devices.size() - 1"),
    ("L4", "mode", "has one switch", r"index\(nodes, caller\(change\)\)", "nodes.size() - 1"),
    ("L4", "hold_to_run", "asks the first device alone", r"i < devices.size\(\)", "i < 1"),
    ("L4", "mode", "asks the first switch alone", r"i < nodes.size\(\)", "i < 1"),
    *(
        ("L4", preset, "does not see another node", r"!\(sinceForeign <= 1\)", "true")
        for preset in ("overspeed", "standstill")
    ),
    ("L4", "estop", "asks the first button alone", r"i < buttons.size\(\)", "i < buttons.size() && i < 1"),
    *(
        ("L4", preset, "takes any node for its source", r'source == "" \|\| caller\(\w+\) == source', "true")
        for preset in ("separation", "fence", "zone", "overspeed", "standstill")
    ),
    ("L4", "zone", "takes any node for that which mutes",
     r'muteNode == "" \|\| caller\(muteSignal\) == muteNode', "true"),
    *(
        ("L4", preset, "does not stop while another node publishes", r"age\(foreign\) <= 1\b", "false")
        for preset in ("separation", "fence")
    ),
    ("L4", "sensor", "does not see another node", r"&& !\(sinceForeign <= 1\)", ""),
    ("L4", "agree", "does not see another node", r"&& !\(sinceForeign <= 1\)", ""),
    ("L4", "zone", "does not see another node", r"\|\| sinceForeign <= 1", ""),
    ("L4", "ready", "does not see another battery", r"&& !\(otherBattery <= silent\)", ""),
    ("L4", "joints", "does not see a third node", r"&& !\(age\(foreign\) <= silent\)", ""),
    ("L4", "joints", "asks one of two nodes", r"&& \(place < 0 \|\| known\) && \(placeToo < 0 \|\| knownToo\)", ""),
    ("L4", "agree", "takes any node for its second source",
     r'otherSource == "" \|\| caller\(two\) == otherSource', "true"),
    ("L6", "hold_to_run", "needs no zero", r"else if \(zeroFirst\)", "else if (false)"),
    ("L6", "hold_to_run", "takes the zero of any node", r"standing == one \|\| standingToo == one", 'standing != ""'),
    ("L6", "hold_to_run", "takes a zero from before the stop",
     r'if \(!enabled\) \{ standing = ""; standingToo = ""; \}', ""),
    ("L6", "hold_to_run", "takes a device that is tied down", r"else if \(state\[place\] == 1\)", "else"),
    ("L6", "overspeed", "needs no zero", r"fast && good && slow && !moves", "fast && good && slow"),
    ("L6", "overspeed", "asks not whether the base stands",
     r"fast && good && slow && !moves", "fast && good && !moves"),
    ("L6", "standstill", "needs no zero", r"escaped && !moves && good && slow", "escaped && good && slow"),
    ("L6", "standstill", "asks not whether the base stands",
     r"escaped && !moves && good && slow", "escaped && !moves && good"),
    ("L6", "zone", "needs no zero", r"\|\| standing != node && standingToo != node", ""),
    ("L6", "zone", "takes the zero of any node", r"standing != node && standingToo != node\)\)", 'standing == ""))'),
    # One of the three places alone leaves 20 ms, in which a command must come: rarer than one in 300 worlds.
    ("L6", "zone", "takes a zero from before the stop", r'standing = "";\s+standingToo = "";', ""),
    ("L6", "zone", "is free at once", r"\|\| !\(now - freeSince >= clear\)", "|| !(now - freeSince >= 0)"),
    ("L6", "mode", "needs no slow command first", r"free && isfinite\(v\)", "isfinite(v)"),
    ("L6", "mode", "takes a slow command from before", r'if \(manual\) \{ slow = ""; slowToo = ""; \}', ""),
)  # fmt: skip
_TERMS: Sequence[tuple[str, str, str, str]] = (
    # preset, what is wrong, a regular expression, its replacement
    ("separation", "counts no braking in the age of a scan",
     r"braking \* \(delay \+ look\) \+ person", "braking * delay + person"),
    ("separation", "counts one interval of the scanner", r"1\.5 \* gap", "gap"),
    ("separation", "lets a person stand while the base brakes", r"\(delay \+ v / braking\)", "delay"),
    ("separation", "forgets a turn", r"\+ fabs\(turn\) \* \(look \+ delay \+ u / braking\) / 2", ""),
    ("separation", "forgets the way of braking", r" - v \* v / \(2 \* braking\)", ""),
    ("separation", "forgets the way of the reaction", r"- v \* delay - v", "- v"),
    ("separation", "lets a person stand in the reaction",
     r"person \* \(delay \+ v / braking\)", "person * v / braking"),
    ("separation", "lets a person stand while a scan ages", r"left / \(v \+ person \+ 1e-9\)", "left / (v + 1e-9)"),
    ("separation", "lets the base stand while a scan ages",
     r"left / \(v \+ person \+ 1e-9\)", "left / (person + 1e-9)"),
    ("separation", "takes a scan as new until it is silent",
     r"fmin\(silent, left / \(v \+ person \+ 1e-9\)\)", "left < 0 ? 0 : silent"),
    ("separation", "forgets the margin", r"clear - margin - person", "clear - person"),
    ("separation", "slows for no person who walks while the base brakes",
     r"\(delay \+ look\) \+ person;", "(delay + look);"),
    ("separation", "slows for no person who walks until the next scan",
     r"person \* \(delay \+ look\)", "person * delay"),
    ("separation", "slows for no reaction", r"braking \* \(delay \+ look\)", "braking * look"),
    ("separation", "slows for no way of braking", r"2 \* braking \* \(clear - still\)", "1e9"),
    ("separation", "has half a width", r"r \* across <= width \?", "r * across <= width / 2 ?"),
    ("fence", "forgets the way until the next position", r"top \* since \+ v \* wait \+ u", "top * since + u"),
    ("fence", "forgets the way of stopping", r"v \* wait \+ u \* ahead, swing", "v * wait, swing"),
    ("fence", "forgets the way of stopping in any direction", r"v \* wait \+ u \* ahead <= here", "v * wait <= here"),
    ("fence", "counts one interval of the positions", r"1\.5 \* gap", "gap"),
    ("fence", "takes the last interval for all", r"fmax\(age\(pose\), 0\.7 \* gap\)", "age(pose)"),
    ("fence", "forgets how old a position becomes", r"silent - since \+ ahead \+ 0\.02", "ahead + 0.02"),
    ("fence", "takes a position as new until it is silent", r"age\(pose\) <= until", "age(pose) <= silent"),
    ("fence", "judges no position", r"lastV > 0 && permitted\(lastV", "false && permitted(lastV"),
)  # fmt: skip
TERMS = {
    f"{preset} {what}": Fault("live" if "interval" in what else "L3", preset, edit(old, to))
    for preset, what, old, to in _TERMS
}
"""Each forgets a term; the worlds without reserve, at the first seeds, must find it."""
FAULTS = {
    **FAULTS,
    **TERMS,
    **{f"{preset} {what}": Fault(law, preset, edit(old, to)) for law, preset, what, old, to in _ROWS},
    **{
        f"a hold of {preset} holds nothing": Fault("L5", preset, patch=(RunningGuard, "hold", lambda _guard: None))
        for preset in (
            "speed", "separation", "fence", "sensor", "estop", "ready", "agree", "sane", "hold_to_run", "mode",
            "overspeed", "standstill", "zone", "diagnostics",
        )
    },
    **{
        f"{preset} hears any node when it begins again": Fault("L4", preset, patch=(Origin, "hears", _hears_any))
        for preset in ("sensor", "ready", "agree", "overspeed", "standstill", "zone")
    },
    **{
        f"a hold of {preset} drops observed messages": Fault("L5", preset, patch=(RunningGuard, "tell", _deaf))
        for preset in ("sensor", "zone")
    },
    **{
        f"a restarted {preset} sends no stop": Fault("L6", preset, patch=(RunningGuard, "restart", _left_as_it_was))
        for preset in ("sane", "rate")
    },
}  # fmt: skip
"""All of them: one by one, rows of `_ROWS`, and a kind of fault in several presets."""


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
