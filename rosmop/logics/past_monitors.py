"""Monitors for formulas about the past: ptltl, and the past part of mtl (`bounded.py` has the future part).

A formula becomes a *program*: its distinct subformulas, each after its operands, with ``previously`` and
``since`` as the only temporal operators. A step computes all from the event and from the values that the last
step kept (Havelund and Rosu, 2002). For each event, the program is folded in advance into the operations that
remain (`FoldedProgram`). Without time bounds it is a finite automaton, which is built if it is small enough.
"""

import copy
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial, reduce
from typing import Any

from rosmop.logics.automaton import MAX_STATES, Automaton, TooManyStatesError, explore, letter_classes, spread
from rosmop.logics.formula import Bounds, Formula, event_names
from rosmop.logics.interface import (
    Categories,
    ClockedProperty,
    CompiledProperty,
    FiniteProperty,
    Run,
    Source,
    UntimedRun,
)

VERDICTS = ("violation", "validation")
ANEW = "anew"
TOLD: tuple[Categories, Categories] = VERDICTS[:1], VERDICTS[1:]
MAX_TABLE_WORK = 2_000_000
MAX_FOLDED = 50_000
FOREVER = 10**30


@dataclass(frozen=True)
class PastInstruction:
    """One subformula; ``operands`` are the numbers of earlier instructions.

    An ``event`` has an index, other operators have bounds.
    """

    operator: str
    operands: tuple[int, ...] = ()
    event: int = -1
    low: int = 0
    high: int | None = None

    @property
    def bounded(self) -> bool:
        return self.low > 0 or self.high is not None

    @property
    def plain(self) -> str:
        return self.operator.removeprefix("abstract ")


class PastProgram:
    """The distinct subformulas, operands first; the last one is the formula."""

    def __init__(self, formula: Formula, events: Sequence[str]) -> None:
        self.events = {name: index for index, name in enumerate(events)}
        self._numbers: dict[PastInstruction, int] = {}
        self.instructions: list[PastInstruction] = []
        self.result = self._add(formula)

    def _emit(
        self, operator: str, *operands: int, low: int = 0, high: int | None = None, event: int = -1
    ) -> int:
        instruction = PastInstruction(operator, operands, event, low, high)
        number = self._numbers.setdefault(instruction, len(self.instructions))
        if number == len(self.instructions):
            self.instructions.append(instruction)
        return number

    def _not(self, operand: int) -> int:
        instruction = self.instructions[operand]
        return instruction.operands[0] if instruction.operator == "not" else self._emit("not", operand)

    def _add(self, formula: Formula) -> int:
        if formula.operator == "event":
            return self._emit("event", event=self.events[formula.name])
        operands = [self._add(operand) for operand in formula.operands]
        operator = formula.operator
        if operator == "not":
            return self._not(operands[0])
        if operator == "implies":
            return self._emit("or", self._not(operands[0]), operands[1])
        if operator == "iff":
            return self._not(self._emit("xor", *operands))
        low, high = formula.bounds or (0, None)
        return self._temporal(operator, operands, low, high)

    def _temporal(self, operator: str, operands: list[int], low: int, high: int | None) -> int:
        abstract = "abstract " if operator.startswith("abstract ") else ""
        operator = operator.removeprefix("abstract ")
        if operator in _OF_ONE:
            operands = [self._emit("true"), *operands]
        if operator in ("historically", "always"):
            operands[1] = self._not(operands[1])
        elif operator.startswith("dual "):
            operands = [self._not(operand) for operand in operands]
        plain = _OF_ONE.get(operator, operator.removeprefix("dual "))
        number = self._emit(abstract + plain, *operands, low=low, high=high)
        dual = operator in ("historically", "always") or operator.startswith("dual ")
        return self._not(number) if dual else number


_OF_ONE = {"once": "since", "historically": "since", "eventually": "until", "always": "until"}


Operation = tuple[str, int, int, int, int]
"""An operator, and the indexes of its value, its operands and its `SinceWindow`.

An `event` has the event's number in place of the first operand.
"""
Residue = tuple[tuple[Operation, ...], tuple[int, ...]]


@dataclass(frozen=True)
class FoldedProgram:
    """A program as runs execute it.

    A run keeps a list of *values*: first `False` and `True`, so a place below 2 is a constant; then the values kept
    for the next step; then those used within one step. ``bounds`` has the bounds of each kept window (None for other
    kept values), ``abstract`` the places of abstract operators. The last residue is for all unnamed events.
    """

    bounds: tuple[Bounds | None, ...]
    abstract: tuple[int, ...]
    residues: tuple[Residue, ...]
    size: int

    @property
    def kept(self) -> slice:
        return slice(2, 2 + len(self.bounds))

    def start(self) -> list[Any]:
        kept = [False if bounds is None else SinceWindow(*bounds) for bounds in self.bounds]
        return [False, True, *kept, *[False] * (self.size - 2 - len(kept))]

    def take(self, values: list[Any], event: int, now: int) -> tuple[int, ...]:
        operations, results = self.residues[event]
        compute(operations, values, event, now)
        return results


def compute(operations: Sequence[Operation], values: list[Any], event: int, now: int) -> None:
    for operator, place, left, right, window in operations:
        if operator == "or":
            values[place] = values[left] or values[right]
        elif operator == "xor":
            values[place] = values[left] is not values[right]
        elif operator == "window":
            values[place] = values[window].step(values[left], values[right], now)
        elif operator == "and":
            values[place] = values[left] and values[right]
        elif operator == "since":
            values[place] = values[right] or (values[left] and values[place])
        else:
            values[place] = left == event


def fold(program: PastProgram, wanted: Sequence[int]) -> FoldedProgram:
    needed = {*wanted}
    for number in range(max(wanted), -1, -1):
        if number in needed:
            needed.update(program.instructions[number].operands)
    chosen = {number: program.instructions[number] for number in sorted(needed)}
    looking = {number: one for number, one in chosen.items() if one.plain in ("since", "previously")}
    kept = {number: place for place, number in enumerate(looking, 2)}
    events = {one.event for one in chosen.values()} | {-1}
    known = sum(1 + len(one.operands) for one in chosen.values()) * len(events) <= MAX_FOLDED
    folds = {event: _Fold(chosen, kept, event if known else None) for event in (events if known else {-1})}
    residues = {event: made.residue(wanted) for event, made in folds.items()}
    return FoldedProgram(
        tuple((one.low, one.high) if one.bounded else None for one in looking.values()),
        tuple(kept[number] for number, one in looking.items() if one.plain != one.operator),
        tuple(residues.get(event, residues[-1]) for event in (*program.events.values(), -1)),
        max(made.size for made in folds.values()),
    )


class _Fold:
    def __init__(self, chosen: dict[int, PastInstruction], kept: dict[int, int], event: int | None) -> None:
        self._chosen = chosen
        self._kept = kept
        self._event = event
        self._places: dict[int, int] = {}
        self._operations: list[Operation] = []
        self.size = 2 + len(kept)

    def residue(self, wanted: Sequence[int]) -> Residue:
        for number, instruction in self._chosen.items():
            self._places[number] = self._place(number, instruction)
        before = {
            place: one
            for number, place in self._kept.items()
            if (one := self._chosen[number]).plain == "previously"
        }
        # Requested values of these operations are read after they have been set for the next event.
        places = [self._places[number] for number in wanted]
        results = tuple(self._emit("or", place, 0) if place in before else place for place in places)
        for place, instruction in reversed(before.items()):
            operand = self._places[instruction.operands[0]]
            if instruction.bounded:
                self._emit("window", 0, operand, place)
            else:
                self._operations.append(("or", place, operand, 0, 0))
        needed, left = {*results}, []
        for operation in reversed(self._operations):
            _, place, *operands, window = operation
            # A window changes unless its left operand holds and its right operand does not.
            if place in needed or place < 2 + len(self._kept) or (window and operands != [1, 0]):
                left.append(operation)
                needed.update(operands)
        return tuple(reversed(left)), results

    def _place(self, number: int, instruction: PastInstruction) -> int:
        operands = [self._places[operand] for operand in instruction.operands]
        operator, kept = instruction.plain, self._kept.get(number, 0)
        if operator == "event" and self._event is None:
            return self._emit("event", instruction.event, 0)
        known = {"event": instruction.event == self._event, "true": True, "false": False}.get(operator)
        if known is not None:
            return int(known)
        if operator == "not":
            return self._join("xor", operands[0], 1)
        if kept and instruction.bounded:
            left, right = operands if operator == "since" else (1, 0)
            return self._emit("window", left, right, kept)
        if kept:
            if operator == "since" and operands != [1, 0]:
                self._operations.append(("since", kept, operands[0], operands[1], 0))
            return kept
        return reduce(partial(self._join, operator), operands)

    def _join(self, operator: str, left: int, right: int) -> int:
        neutral = int(operator == "and")
        if left == neutral:
            return right
        if right == neutral:
            return left
        if 1 - neutral in (left, right) and operator != "xor":
            return 1 - neutral
        return 0 if left == right == 1 else self._emit(operator, left, right)

    def _emit(self, operator: str, left: int, right: int, window: int = 0) -> int:
        self._operations.append((operator, self.size, left, right, window))
        self.size += 1
        return self.size - 1


def compile_past(source: Source, formula: Formula) -> CompiledProperty:
    program = PastProgram(formula, source.events)
    folded = fold(program, [program.result])
    bounds = [found for found in folded.bounds if found is not None]
    named = event_names(formula)
    of_event, classes = letter_classes(source.events, named)
    letters = [source.events.index(named[index]) if index >= 0 else -1 for index in classes]
    try:
        if not bounds:
            return FiniteProperty(source, VERDICTS, spread(_table(folded, letters), of_event))
        low, high = bounds[0]
        if len(bounds) == 1 and (low == 0 or high is None):
            late = [len(classes) + letter for letter in of_event]
            automaton = spread(_table(folded, letters, clocked=True), [*of_event, *late])
            return ClockedPastProperty(source, automaton, low - 1 if high is None else high)
    except TooManyStatesError:
        pass
    return PastProperty(source, folded)


def _table(folded: FoldedProgram, letters: Sequence[int], *, clocked: bool = False) -> Automaton:
    """Return the automaton over letters; letter ``i`` is the event ``letters[i]`` (-1: any unnamed event).

    With a clock, each letter has a second form for events after the clock has run out. A state whose step restarts
    the clock has `ANEW` after its verdict.
    """
    values, kept, many = folded.start(), folded.kept, len(letters)

    def step(state: tuple[tuple[bool, ...], bool, bool], letter: int) -> tuple[tuple[bool, ...], bool, bool]:
        windows = [
            value if bounds is None else _Clock(value, first=bounds[1] is None)
            for bounds, value in zip(folded.bounds, state[0], strict=True)
        ]
        values[kept] = windows
        (result,) = folded.take(values, letters[letter % many], letter >= many)
        anew = any(isinstance(window, _Clock) and window.anew for window in windows)
        return tuple(map(bool, values[kept])), values[result], anew

    work = sum(1 + len(folded.residues[letter][0]) for letter in letters) << clocked
    return explore(
        ((False,) * len(folded.bounds), False, False),
        many << clocked,
        step,
        lambda state: (*TOLD[state[1]], ANEW) if state[2] else TOLD[state[1]],
        min(MAX_STATES, 1 + MAX_TABLE_WORK // work),
    )


class _Clock:
    """A window in a table that begins at once, or (with ``first``) never ends; its state is whether it exists.

    The time only matters as whether more than the bound has passed since the window's last anchor, or with ``first``
    since its first anchor.
    """

    def __init__(self, there: bool, *, first: bool) -> None:
        self._there = there
        self._first = first
        self.anew = False

    def __bool__(self) -> bool:
        return self._there

    def step(self, unbroken: bool, anchor: bool, late: bool) -> bool:
        self._there = self._there and unbroken and (self._first or not late)
        if anchor and not (self._first and self._there):
            self._there = self.anew = True
        return self._there and (not self._first or (late and not self.anew))


class ClockedPastProperty(ClockedProperty):
    """A past formula with one time bound in one window, a `_Clock`."""

    def __init__(self, source: Source, automaton: Automaton, within: int) -> None:
        super().__init__(source, VERDICTS)
        self.initial, self.within = automaton.initial, within
        self.verdicts = tuple(verdict[:1] for verdict in automaton.verdicts)
        self.waits = (None,) * len(automaton)
        rows = [[(target, ANEW in automaton.verdicts[target]) for target in row] for row in automaton.table]
        self.moves = tuple(tuple(row[: len(self.events)]) for row in rows)
        self.late = tuple(tuple(row[len(self.events) :]) for row in rows)


class SinceWindow:
    """The state of ``since[low,high]``: the intervals of time in which it will hold while the left operand holds.

    Intervals that touch are merged, so there are at most about ``low/(high-low)`` of them, and never more than the
    events within ``low``.
    """

    __slots__ = ("_high", "_intervals", "_low")

    def __init__(self, low: int, high: int | None) -> None:
        self._low = low
        self._high = FOREVER if high is None else high
        self._intervals: deque[tuple[int, int]] = deque()

    def step(self, unbroken: bool, anchor: bool, now: int) -> bool:
        intervals = self._intervals
        if intervals and not unbroken:
            intervals.clear()
        if anchor:
            begin, end = now + self._low, now + self._high
            if intervals and begin <= intervals[-1][1] + 1:
                intervals[-1] = intervals[-1][0], end
            else:
                intervals.append((begin, end))
        while intervals:
            begin, end = intervals[0]
            if end >= now:
                return begin <= now
            intervals.popleft()
        return False

    def __copy__(self) -> "SinceWindow":
        twin = SinceWindow(self._low, self._high)
        twin._intervals = self._intervals.copy()
        return twin

    def save(self) -> tuple[int, deque[tuple[int, int]], int]:
        return self._high, self._intervals, self._low

    def restore(self, saved: tuple[int, deque[tuple[int, int]], int]) -> None:
        self._high, self._intervals, self._low = saved

    def __len__(self) -> int:
        return len(self._intervals)


class PastRun(UntimedRun):
    __slots__ = ("_residues", "now", "values")

    def __init__(self, folded: FoldedProgram, time_ns: int) -> None:
        self._residues = folded.residues
        self.values = folded.start()
        self.now = time_ns

    def __copy__(self) -> "PastRun":
        made = PastRun.__new__(PastRun)
        made._residues, made.now, made.values = self._residues, self.now, self.mark()
        return made

    def step(self, event: int, time_ns: int) -> Categories:
        if time_ns > self.now:  # noqa: PLR1730  `max` takes as long as the rest of the step
            self.now = time_ns
        operations, (result,) = self._residues[event]
        if operations:
            compute(operations, self.values, event, self.now)
        return TOLD[self.values[result]]

    def mark(self) -> list[Any]:
        return list(map(copy.copy, self.values))

    def take_back(self, mark: list[Any]) -> None:
        self.values = mark

    def save(self) -> tuple[int, list[Any]]:
        return self.now, self.values

    def restore(self, saved: tuple[int, list[Any]]) -> None:
        self.now, self.values = saved


class PastProperty(CompiledProperty):
    """A past formula without tables."""

    def __init__(self, source: Source, folded: FoldedProgram) -> None:
        super().__init__(source, VERDICTS)
        self._folded = folded
        self.timed = any(folded.bounds)

    def start(self, time_ns: int) -> Run:
        return PastRun(self._folded, time_ns)
