"""Monitors for formulas about the past: ptltl, and the past part of mtl (`bounded.py` has the other part).

Theory of operation. A formula becomes a *program*: its distinct subformulas in an order in which each
follows its operands, with only ``previously`` and ``since`` left of the temporal operators (``once b`` is
``true since b``). A step computes all of them from the event and from what the last step left behind
(Havelund and Rosu, 2002):

- ``previously``: the value of the operand at the last event, and the time of it;
- ``since`` without bounds: its own last value;
- ``since[0,u]``: when the right operand held last; ``since[l,inf]``: when it held first;
- ``since[l,u]``: the intervals of time in which it will hold if the left operand goes on to hold. Intervals
  that touch are merged, so there are at most about ``l/(u-l)`` of them (and never more than events within
  ``l``).

Without time bounds the values are bits and the program a finite automaton, which is built if it is small
enough. Otherwise the program becomes a Python function of straight-line code.
"""

import copy
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from appliance.rosmop.logics.automaton import (
    Automaton,
    TooManyStatesError,
    explore,
    letter_classes,
    spread,
)
from appliance.rosmop.logics.formula import Formula, event_names
from appliance.rosmop.logics.interface import (
    Categories,
    CompiledProperty,
    FiniteProperty,
    Run,
    Source,
    UntimedRun,
)

VERDICTS = ("violation", "validation")
MAX_TABLE_STATES = 4_096
"""Formulas whose automaton would be larger are computed instead of looked up."""
MAX_TABLE_WORK = 2_000_000
"""How many values may be computed to build a table."""

NEVER = -(10**30)
"""A time before all times."""


@dataclass(frozen=True)
class Instruction:
    """One subformula: ``operands`` are earlier instructions; an ``event`` has its index, others their
    bounds."""

    operator: str
    operands: tuple[int, ...] = ()
    event: int = -1
    low: int = 0
    high: int | None = None

    @property
    def bounded(self) -> bool:
        """Whether the time of events plays a part."""
        return self.low > 0 or self.high is not None


class Program:
    """The distinct subformulas of a formula, operands first; the last one is the formula."""

    def __init__(self, formula: Formula, events: Sequence[str]) -> None:
        self._events = {name: index for index, name in enumerate(events)}
        self._numbers: dict[Instruction, int] = {}
        self.instructions: list[Instruction] = []
        self.result = self._add(formula)

    @property
    def bounded(self) -> bool:
        """Whether any operator has a time bound."""
        return any(instruction.bounded for instruction in self.instructions)

    def _emit(
        self, operator: str, *operands: int, low: int = 0, high: int | None = None, event: int = -1
    ) -> int:
        instruction = Instruction(operator, operands, event, low, high)
        number = self._numbers.setdefault(instruction, len(self.instructions))
        if number == len(self.instructions):
            self.instructions.append(instruction)
        return number

    def _not(self, operand: int) -> int:
        instruction = self.instructions[operand]
        return instruction.operands[0] if instruction.operator == "not" else self._emit("not", operand)

    def _add(self, formula: Formula) -> int:
        """The number of a subformula, itself and its operands added if they are new."""
        if formula.operator == "event":
            return self._emit("event", event=self._events[formula.name])
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
"""Operators that are said by another one, whose left operand is `true`."""


def compile_past(source: Source, formula: Formula) -> CompiledProperty:
    """The monitor of a past formula: a table where it is finite and small, else a function."""
    program = Program(formula, source.events)
    if not program.bounded:
        named = event_names(formula)
        of_event, classes = letter_classes(source.events, named)
        letters = [source.events.index(named[index]) if index >= 0 else -1 for index in classes]
        try:
            automaton = _table(program, letters)
        except TooManyStatesError:
            pass
        else:
            return FiniteProperty(source, VERDICTS, spread(automaton, of_event))
    return PastProperty(source, program)


class Stepper:
    """Steps a program without time bounds; what it remembers of an event are bits."""

    def __init__(self, program: Program) -> None:
        self._program = program
        remembered = [
            (number, instruction)
            for number, instruction in enumerate(program.instructions)
            if instruction.operator.removeprefix("abstract ") in ("since", "previously")
        ]
        self._place = {number: 1 << index for index, (number, _) in enumerate(remembered)}
        self._kept = [
            (
                self._place[number],
                number if instruction.operator.endswith("since") else instruction.operands[0],
            )
            for number, instruction in remembered
        ]
        self.abstract = sum(
            self._place[number] for number, instruction in remembered if instruction.operator[0] == "a"
        )
        """The bits of what abstract operators remember."""

    def step(self, bits: int, event: int) -> tuple[int, bool]:
        """What is remembered of an event, given that of the last one, and whether the formula holds."""
        values = _evaluate(self._program, self._place, bits, event)
        return sum(place for place, number in self._kept if values[number]), values[self._program.result]


def _table(program: Program, letters: Sequence[int]) -> Automaton:
    """The automaton over letters, of which the formula names ``letters[i]`` (-1: none of its events)."""
    stepper = Stepper(program)
    return explore(
        (0, False),
        len(letters),
        lambda state, letter: stepper.step(state[0], letters[letter]),
        lambda state: ("validation",) if state[1] else ("violation",),
        min(MAX_TABLE_STATES, 1 + MAX_TABLE_WORK // (len(program.instructions) * len(letters))),
    )


def _evaluate(program: Program, place: dict[int, int], bits: int, event: int) -> list[bool]:
    """The values of all subformulas at an event, given the bits that the last one left."""
    values: list[bool] = []
    for number, instruction in enumerate(program.instructions):
        operands = [values[operand] for operand in instruction.operands]
        operator = instruction.operator.removeprefix("abstract ")
        if operator == "event":
            value = instruction.event == event
        elif operator in ("true", "false"):
            value = operator == "true"
        elif operator == "not":
            value = not operands[0]
        elif operator == "and":
            value = all(operands)
        elif operator == "or":
            value = any(operands)
        elif operator == "xor":
            value = sum(operands) % 2 == 1
        elif operator == "previously":
            value = bool(bits & place[number])
        else:
            value = operands[1] or (operands[0] and bool(bits & place[number]))
        values.append(value)
    return values


class Window:
    """``since[low,high]`` with both bounds: the intervals of time in which it will hold."""

    __slots__ = ("_high", "_intervals", "_low")

    def __init__(self, low: int, high: int) -> None:
        self._low = low
        self._high = high
        self._intervals: deque[list[int]] = deque()

    def copy(self) -> "Window":
        """Another one that has seen the same."""
        other = Window(self._low, self._high)
        other._intervals.extend(interval.copy() for interval in self._intervals)
        return other

    def step(self, unbroken: bool, anchor: bool, now: int) -> bool:
        """The value at ``now``, where the left operand is ``unbroken`` and the right one ``anchor``."""
        intervals = self._intervals
        if not unbroken:
            intervals.clear()
        if anchor:
            if intervals and now + self._low <= intervals[-1][1] + 1:
                intervals[-1][1] = now + self._high
            else:
                intervals.append([now + self._low, now + self._high])
        while intervals and intervals[0][1] < now:
            intervals.popleft()
        return bool(intervals) and intervals[0][0] <= now

    def __copy__(self) -> "Window":
        twin = Window(self._low, self._high)
        twin._intervals.extend(map(list, self._intervals))
        return twin

    def __len__(self) -> int:
        return len(self._intervals)


StepFunction = Callable[[int, int], Categories]
Made = tuple[StepFunction, Callable[[], Any]]


class PastRun(UntimedRun):
    """A run of a past formula; ``step`` is the compiled function itself, ``twin`` makes one that goes on from here."""

    __slots__ = ("step", "twin")

    def __init__(self, step: StepFunction, twin: "Callable[[], Made]") -> None:
        self.step = step
        self.twin = twin

    def __copy__(self) -> "PastRun":
        return PastRun(*self.twin())


class PastProperty(CompiledProperty):
    """A past formula as a function. ``code`` is its source text, for the curious."""

    def __init__(self, source: Source, program: Program) -> None:
        super().__init__(source, VERDICTS)
        self._timed = program.bounded
        everything = range(len(program.instructions))
        self.code = generate(program, everything, f"VALIDATION if v{program.result} else VIOLATION")
        self._make: Callable[[int], Made] = loaded(self.code)

    @property
    def timed(self) -> bool:
        """Whether the formula has time bounds."""
        return self._timed

    def start(self, time_ns: int) -> Run:
        """A fresh run."""
        return PastRun(*self._make(time_ns))


def generate(program: Program, computed: Iterable[int], result: str) -> str:
    """The text of ``make(now)``: it returns a step function with the state of one run in its closure,
    and a function that makes the same once more, to go on from there.

    ``computed`` are the instructions that it computes, operands first (``v`` and the number is the value of one), and
    ``result`` is what a step gives.
    """
    return _Generator(program).text(computed, result)


def loaded(code: str) -> Callable[[int], Any]:
    """The function that ``generate`` has written."""
    namespace: dict[str, Any] = {
        "Window": Window,
        "VALIDATION": VERDICTS[1:],
        "VIOLATION": VERDICTS[:1],
        "copy": copy.copy,
    }
    exec(compile(code, "<past formula>", "exec"), namespace)  # noqa: S102  # made of numbers only
    make: Callable[[int], Any] = namespace["make"]
    return make


class _Generator:
    def __init__(self, program: Program) -> None:
        self._program = program
        self._state: dict[str, str] = {}
        self._body: list[str] = []
        self._after: list[str] = []

    def text(self, computed: Iterable[int], result: str) -> str:
        program = self._program
        for number in computed:
            self._write(number, program.instructions[number])
        if program.bounded:
            self._state["now"] = "now"
            clock = ["if t < now: t = now"]
            self._after.append("now = t")
        else:
            clock = []
        lines = [*clock, *self._body, *self._after]
        assigned = [name for name, initial in self._state.items() if not initial.startswith("Window")]
        if assigned:
            lines.insert(0, f"nonlocal {', '.join(assigned)}")
        lines.append(f"return {result}")
        initial = {name: value for name, value in self._state.items() if name != "now"}
        kept = "".join(f"copy({name}), " for name in initial)
        names, values = ("".join(f"{item}, " for item in items) for items in (initial, initial.values()))
        return "\n".join(
            [
                "def make(now, kept=None):",
                f"    {names} = kept or ({values})" if names else "",
                "    def step(e, t):",
                *(f"        {line}" for line in lines),
                "    def twin():",
                f"        return make(now, ({kept}))",
                "    return step, twin",
                "",
            ]
        )

    def _write(self, number: int, instruction: Instruction) -> None:
        operator = instruction.operator
        names = [f"v{operand}" for operand in instruction.operands]
        if operator == "since":
            self._since(number, instruction)
        elif operator == "previously":
            self._previously(number, instruction)
        else:
            expressions = {
                "event": f"e == {instruction.event}",
                "true": "True",
                "false": "False",
                "not": f"not {names[0]}" if names else "",
                "and": " and ".join(names),
                "or": " or ".join(names),
                "xor": f"sum(({', '.join(names)},)) % 2 == 1" if len(names) > 2 else " ^ ".join(names),
            }
            self._body.append(f"v{number} = {expressions[operator]}")

    def _previously(self, number: int, instruction: Instruction) -> None:
        kept = f"p{number}"
        self._state[kept] = "False"
        tests = [kept]
        if instruction.low:
            tests.append(f"t - now >= {instruction.low}")
        if instruction.high is not None:
            tests.append(f"t - now <= {instruction.high}")
        self._body.append(f"v{number} = {' and '.join(tests)}")
        self._after.append(f"{kept} = v{instruction.operands[0]}")

    def _since(self, number: int, instruction: Instruction) -> None:
        left, right = (f"v{operand}" for operand in instruction.operands)
        always = self._program.instructions[instruction.operands[0]].operator == "true"
        kept, low, high = f"s{number}", instruction.low, instruction.high
        if not instruction.bounded:
            self._state[kept] = "False"
            self._body.append(f"v{number} = {kept} = {right} or ({kept} and {left})")
        elif low and high is not None:
            self._state[kept] = f"Window({low}, {high})"
            self._body.append(f"v{number} = {kept}.step({left}, {right}, t)")
        elif high is not None:
            self._state[kept] = str(NEVER)
            self._body.append(f"if {right}: {kept} = t")
            if not always:
                self._body.append(f"elif not {left}: {kept} = {NEVER}")
            self._body.append(f"v{number} = t - {kept} <= {high}")
        else:
            self._state[kept] = str(-NEVER)
            if not always:
                self._body.append(f"if not {left}: {kept} = {-NEVER}")
            self._body.append(f"if {right} and {kept} > t: {kept} = t")
            self._body.append(f"v{number} = t - {kept} >= {low}")
