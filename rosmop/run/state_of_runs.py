"""Runs of properties as plain data that outlives a process, and back.

The values that change (`saved`) become numbers, strings and arrays of MessagePack. A container is `[tag, item, …]`.
An object with several references is `["o", number]`, an entry of a table. Reading creates only objects of the classes
below.
"""

from collections import deque
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from rosmop.logics.bounded import PARTS, BoundedRun, FormulaCell
from rosmop.logics.cfg import GrammarProperty
from rosmop.logics.interface import ClockedRun, CompiledProperty, FiniteRun, Run
from rosmop.logics.parsing import EarleySet, EarleyShape

MAX_PARTS = 5_000
"""Limits the objects of one run, of which there are usually a hundred times fewer."""

_CONTAINERS: Mapping[str, Callable[[list[Any]], Any]] = MappingProxyType(
    {"l": list, "t": tuple, "d": deque, "s": set}
)
_TAGS = MappingProxyType({made: tag for tag, made in _CONTAINERS.items()})
_PARTS: Mapping[str, type[Any]] = MappingProxyType({**PARTS, "frame": EarleySet})
_NAMES = MappingProxyType({part: name for name, part in _PARTS.items()})
_SMALL = 1 << 63


class StateTooLargeError(Exception):
    """A state has too many parts or bytes."""


def dump(run: Run) -> list[list[object]]:
    if isinstance(run, FiniteRun | ClockedRun):
        return [[*run.save()], []]
    return _Writer(run).write()


def run_of(compiled: CompiledProperty, data: object, time_ns: int) -> Run:
    """Read the data of `dump`. Raises `ValueError`."""
    run = compiled.start(time_ns)
    try:
        _Reader(compiled, run, data).read()
        _ = run.deadline
    except (ArithmeticError, AttributeError, LookupError, TypeError, RecursionError) as error:
        raise ValueError(f"the state of a property cannot be read: {error!r:.100}") from error
    return run


class _Writer:
    def __init__(self, run: Run) -> None:
        self._run = run
        self._numbers: dict[int, int] = {}
        self._parts: list[Any] = []
        self._operators: dict[int, int] = (
            {id(operator): number for number, operator in run.operators.items()}
            if isinstance(run, BoundedRun)
            else {}
        )

    def write(self) -> list[list[object]]:
        run = self._run
        fields = [
            *map(self._value, run.save()),
            *([self._operators_of(run)] if isinstance(run, BoundedRun) else []),
        ]
        parts: list[object] = []
        for part in self._parts:  # the list grows while parts refer to other parts
            if len(parts) >= MAX_PARTS:
                raise StateTooLargeError(f"a property has more than {MAX_PARTS} parts")
            parts.append(self._part(part))
        return [fields, parts]

    def _operators_of(self, run: BoundedRun) -> list[object]:
        return [[number, *map(self._value, operator.save())] for number, operator in run.operators.items()]

    def _part(self, part: Any) -> list[object]:
        if isinstance(part, EarleyShape):
            return ["shape", *map(self._value, (part.items, part.done, part.width))]
        return [_NAMES[type(part)], *map(self._value, part.save())]

    def _value(self, value: Any) -> object:
        if value is None or isinstance(value, bool | float | str):
            return value
        if isinstance(value, int):
            return value if -_SMALL <= value < _SMALL else ["i", str(value)]
        tag = _TAGS.get(type(value))
        if tag is not None:
            return [tag, *map(self._value, value)]
        if isinstance(value, dict):
            return ["m", *(self._value(one) for pair in value.items() for one in pair)]
        if id(value) in self._operators:
            return ["p", self._operators[id(value)]]
        number = self._numbers.setdefault(id(value), len(self._numbers))
        if number == len(self._parts):
            self._parts.append(value)
        return ["o", number]


class _Reader:
    def __init__(self, compiled: CompiledProperty, run: Any, data: Any) -> None:
        self._compiled = compiled
        self._run = run
        self._fields, self._entries = data
        if len(self._entries) > MAX_PARTS:
            raise ValueError(f"a property has more than {MAX_PARTS} parts")
        self._parts: list[Any] = []

    def read(self) -> None:
        self._parts = [self._make(entry) for entry in self._entries]
        for part, (name, *fields) in zip(self._parts, self._entries, strict=True):
            if name != "shape":
                self._fill(part, fields)
        run = self._run
        if isinstance(run, FiniteRun | ClockedRun):
            self._fill(run, self._fields)
            self._check(run)
        elif isinstance(run, BoundedRun):
            self._fill_run(self._fields[:-1])
            self._fill_operators(run, self._fields[-1])
        else:
            self._fill_run(self._fields)

    def _check(self, run: FiniteRun | ClockedRun) -> None:
        compiled: Any = self._compiled
        states = len(compiled.automaton) if isinstance(run, FiniteRun) else len(compiled.moves)
        if not all(isinstance(value, int) for value in run.save()) or not 0 <= run.state < states:
            raise ValueError("the property has no such state")

    def _make(self, entry: list[Any]) -> Any:
        if entry[0] != "shape":
            made = object.__new__(_PARTS[entry[0]])
            if isinstance(made, FormulaCell):
                made.journal = self._run.journal
            return made
        if not isinstance(self._compiled, GrammarProperty):
            raise ValueError("only a grammar has shapes")
        items, done, width = map(self._value, entry[1:])
        return self._compiled.recogniser.shape(items, done, width)

    def _fill_operators(self, run: BoundedRun, entries: list[Any]) -> None:
        if [number for number, *_ in entries] != [*run.operators]:
            raise ValueError("the operators of the property differ")
        for number, *fields in entries:
            self._fill(run.operators[number], fields)

    def _fill_run(self, fields: list[object]) -> None:
        """Fill the run with values of the types that it has; only a grammar's frame may become None."""
        before = self._run.save()
        self._fill(self._run, fields)
        for first, value in zip(before, self._run.save(), strict=True):
            if not isinstance(value, type(first)) and not (value is None and isinstance(first, EarleySet)):
                raise ValueError("a property has no such state")

    def _fill(self, target: Any, fields: list[object]) -> None:
        target.restore(tuple(map(self._value, fields)))

    def _value(self, value: Any) -> Any:
        if not isinstance(value, list):
            return value
        tag, *items = value
        if tag in _CONTAINERS:
            return _CONTAINERS[tag]([self._value(item) for item in items])
        if tag == "m":
            found = [self._value(item) for item in items]
            return dict(zip(found[::2], found[1::2], strict=True))
        if tag == "o":
            return self._parts[items[0]]
        if tag == "p":
            return self._run.operators[items[0]]
        if tag == "i":
            return int(items[0][:40])
        raise ValueError(f"there is no part {tag!r:.20}")
