"""Monitors for mtl formulas about a bounded future (`past_monitors.py` implements the part about the past).

Subformulas that only look back are computed at their event (`FoldedProgram`). Every other subformula has a
*cell* for each event at which its value is open and needed: for `fire => eventually[0,1s] safe`, only the
waiting `fire` events are kept. A decided cell notifies its *users*.

- `until` over operands known at once decides the oldest waiting event first, so the cost of a step does not depend on
their number.
- `until` and `since` over open operands keep *rows*, one for each relevant event. Both operators are monotonic, so a
result is certain if it is the same whether all open operands fail or all hold. When an operand is decided, `until`
visits only the rows that it may decide; `since` visits all rows.

To undo a step, `BoundedRun.mark` copies the operators' rows, and `FormulaCell.touch` copies each cell before
its first change. Rows do not change after their step.
"""

from abc import ABC, abstractmethod
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Mapping
from copy import copy, deepcopy
from dataclasses import dataclass
from typing import Any

from rosmop.logics.formula import Formula
from rosmop.logics.interface import Categories, CompiledProperty, CostlyRun, Run, RunFaultError, Source
from rosmop.logics.past_monitors import FOREVER, VERDICTS, PastInstruction, PastProgram, SinceWindow, fold

MAX_OPEN = 10_000

STEP_COST = 20
"""The instructions that each waiting event counts at a step."""

MAX_OPEN_IN_SLICE = 1_000
"""Less than `MAX_OPEN`, because a parametric specification may have many slices."""

_LATER = ("until", "next")


class FormulaCell:
    """The open value of a subformula at one event.

    `tells` is the number of the event if the subformula is the whole formula, and otherwise 0. With a `kind`
    the value is computed from `operands`, of which `missing` are open.
    """

    __slots__ = ("journal", "kind", "missing", "operands", "tells", "users", "value")

    def __init__(self, journal: "Journal") -> None:
        self.journal = journal
        self.users: list[FormulaCell | _Operator] = []
        self.tells = 0
        self.value: bool | None = None
        self.kind, self.missing = "", 0
        self.operands: tuple[Value, ...] = ()

    def touch(self) -> None:
        if self not in self.journal:
            self.journal[self] = self.save()

    def save(self) -> "_CellState":
        return self.kind, self.missing, self.operands, self.tells, [*self.users], self.value

    def restore(self, saved: "_CellState") -> None:
        self.kind, self.missing, self.operands, self.tells, self.users, self.value = saved

    def stand_for(self, kind: str, operands: tuple["Value", ...]) -> None:
        self.touch()
        self.kind, self.operands = kind, operands
        self.missing = sum(_use(operand, self) for operand in operands)

    @property
    def wanted(self) -> bool:
        return self.value is None and bool(self.tells or self.users)

    def hear(self, value: bool) -> bool | None:
        self.touch()
        self.missing -= 1
        if self.kind == "not":
            return not value
        if value is _ABSORBING.get(self.kind):
            return value
        return None if self.missing else _together(self.kind, self.operands)


Value = bool | FormulaCell
_CellState = tuple[str, int, tuple[Value, ...], int, "list[FormulaCell | _Operator]", bool | None]
Journal = dict[FormulaCell, _CellState]


def _known(value: Value) -> bool | None:
    return value.value if isinstance(value, FormulaCell) else value


def _use(value: Value, user: "FormulaCell | _Operator") -> bool:
    if isinstance(value, FormulaCell) and value.value is None:
        value.touch()
        value.users.append(user)
        return True
    return False


def _leave(value: Value, user: "FormulaCell | _Operator") -> None:
    waiting = [(value, user)]
    while waiting:
        left, leaver = waiting.pop()
        if isinstance(left, FormulaCell) and left.value is None:
            left.touch()
            left.users.remove(leaver)
            if not left.wanted:
                waiting += [(operand, left) for operand in left.operands]


_ABSORBING = {"and": False, "or": True}


def _together(kind: str, operands: tuple[Value, ...]) -> bool:
    if kind == "xor":
        return sum(map(bool, map(_known, operands))) % 2 == 1
    return bool(_known(operands[0])) is not (kind == "not")


@dataclass(eq=False, slots=True)
class _Row:
    """An event that an operator keeps. `cell` is set if the value was requested."""

    place: int
    time: int
    left: Value | None
    right: Value | None
    cell: FormulaCell | None

    def save(self) -> tuple[int, int, Value | None, Value | None, FormulaCell | None]:
        return self.place, self.time, self.left, self.right, self.cell

    def restore(self, saved: tuple[int, int, Value | None, Value | None, FormulaCell | None]) -> None:
        self.place, self.time, self.left, self.right, self.cell = saved


class _Operator(ABC):
    """An operator; for each event, `ask` comes before `take`, and `pass_by` comes between events."""

    def __init__(self, run: "BoundedRun", number: int, instruction: PastInstruction) -> None:
        self.run, self.number = run, number
        self.left, self.right = instruction.operands[0], instruction.operands[-1]
        self.low, self.high = instruction.low, FOREVER if instruction.high is None else instruction.high
        self.rows: deque[_Row] = deque()

    def ask(self, now: int) -> Value:
        self.rows.append(_Row(self.run.place, now, None, None, FormulaCell(self.run.journal)))
        return self.rows[-1].cell or False

    @abstractmethod
    def take(self, now: int) -> None: ...

    def settle(self) -> None:  # noqa: B027  only two operators have open operands
        """Decide the rows that have become certain."""

    def hear(self, cell: FormulaCell) -> None:
        """Note that an open operand has a value. One call of `settle` follows for all such operands."""
        del cell

    def pass_by(self, time: int) -> None:
        del time

    @property
    def deadline(self) -> int | None:
        return None

    def save(self) -> tuple[object, ...]:
        return (self.rows,)

    def restore(self, saved: tuple[Any, ...]) -> None:
        (self.rows,) = saved


class _Until(_Operator):
    def take(self, now: int) -> None:
        rows = self.rows
        if not rows:
            return
        if self.run.value(self.right):
            while rows and rows[0].time <= now - self.low:
                self.run.decide(rows.popleft().cell, True)
        if not self.run.value(self.left):
            while rows:
                self.run.decide(rows.popleft().cell, False)

    def pass_by(self, time: int) -> None:
        while self.rows and self.rows[0].time + self.high <= time:
            self.run.decide(self.rows.popleft().cell, False)

    @property
    def deadline(self) -> int | None:
        while self.rows and not _wanted(self.rows[0]):
            self.rows.popleft()
        return self.rows[0].time + self.high if self.rows else None


def _wanted(row: _Row) -> bool:
    return row.cell is not None and row.cell.wanted


_Mark = tuple[int, int]
_Marks = tuple[list[_Mark], ...]


class _Rows(_Operator):
    def keep(self, now: int) -> _Row:
        if not self.rows or self.rows[-1].left is not None:
            self.rows.append(_Row(self.run.place, now, None, None, None))
        row = self.rows[-1]
        row.left, row.right = self.run.value(self.left), self.run.value(self.right)
        _use(row.left, self)
        _use(row.right, self)
        return row

    def drop(self) -> _Row:
        row = self.rows.popleft()
        for value in (row.left, row.right):
            if value is not None:
                _leave(value, self)
        return row


class _OpenUntil(_Rows):
    """`until` over values that may be open. Bounds up to the time `passed` have expired.

    The undecided rows (`pending`) are decided from sorted marks of events: where the right operand holds
    (`holds`) or may hold (`hopes`), and where the left operand fails (`fails`) or may fail (`doubts`). A new
    value concerns only the rows for which it was the first or last of its kind. They are found by their
    times, so a step costs only the rows that it decides.
    """

    def __init__(self, run: "BoundedRun", number: int, instruction: PastInstruction) -> None:
        super().__init__(run, number, instruction)
        self.passed = -FOREVER
        self.pending: list[tuple[int, int, _Row]] = []
        self.holds: list[_Mark] = []
        self.hopes: list[_Mark] = []
        self.fails: list[_Mark] = []
        self.doubts: list[_Mark] = []
        self.waits: dict[FormulaCell, list[tuple[_Mark, bool]]] = {}
        self.heard: list[FormulaCell] = []

    def take(self, now: int) -> None:
        if not self.rows:
            return
        row = self.keep(now)
        mark = row.time, row.place
        if row.cell is not None:
            self.pending.append((*mark, row))
        for value, of_right, waiting in ((row.left, False, self.doubts), (row.right, True, self.hopes)):
            if isinstance(value, FormulaCell):
                self.waits[value] = [*self.waits.get(value, ()), (mark, of_right)]
                waiting.append(mark)
        if row.right is True:
            self._know_right(mark, True)
        if row.left is False:
            self._know_left(mark, False)
        self._forget()

    def hear(self, cell: FormulaCell) -> None:
        self.heard.append(cell)

    def settle(self) -> None:
        heard, self.heard = self.heard, []
        for cell in heard:
            for mark, of_right in self.waits.pop(cell, ()):
                waiting = self.hopes if of_right else self.doubts
                del waiting[bisect_left(waiting, mark)]
                (self._know_right if of_right else self._know_left)(mark, bool(cell.value))
        self._forget()

    def _know_right(self, mark: _Mark, holds: bool) -> None:
        time, place = mark
        begins = [(time - self.high, 0), _behind(_last((self.fails,), mark))]
        ends = [(time - self.low + 1, 0), (time, place + 1)]
        if holds:
            insort(self.holds, mark)
            begins.append(_behind(_last((self.doubts,), mark)))
        else:
            begins.append(_behind(_last((self.holds, self.hopes), mark), self.low))
            following, fail = _first((self.holds, self.hopes), mark), _first((self.fails,), mark)
            if following is not None and (fail is None or following <= fail):
                ends.append((following[0] - self.high, 0))
            elif fail is None:
                ends.append((self.passed - self.high + 1, 0))
        self._look(begins, ends)

    def _know_left(self, mark: _Mark, holds: bool) -> None:
        time, place = mark
        if not holds:
            insort(self.fails, mark)
            come = _last((self.holds, self.hopes), (time, place + 1))
            self._look([_behind(_last((self.fails,), mark)), _behind(come, self.low)], [(time, place + 1)])
            return
        until = _first((self.fails, self.doubts), mark) or (FOREVER, 0)
        good = _first((self.holds,), (time, place + 1))
        best = _last((self.holds,), (until[0], until[1] + 1))
        if good is not None and best is not None and good <= best:
            begins = [(good[0] - self.high, 0), _behind(_last((self.fails, self.doubts), mark))]
            self._look(begins, [(best[0] - self.low + 1, 0), (time, place + 1)])

    def _look(self, begins: list[_Mark], ends: list[_Mark]) -> None:
        begin = bisect_left(self.pending, max(begins))
        end = max(begin, bisect_left(self.pending, min(ends)))
        self.pending[begin:end] = [entry for entry in self.pending[begin:end] if not self._decided(entry[2])]

    def _decided(self, row: _Row) -> bool:
        if _wanted(row):
            sure = self._value(row, (self.holds,), (self.fails, self.doubts))
            onward = (
                row.time + self.high > self.passed and _first((self.fails,), (row.time, row.place)) is None
            )
            possible = onward or self._value(row, (self.holds, self.hopes), (self.fails,))
            if sure is not possible:
                return False
            self.run.decide(row.cell, sure)
        return True

    def _value(self, row: _Row, goods: _Marks, bads: _Marks) -> bool:
        good = _first(goods, (row.time + self.low, row.place))
        if good is None or good[0] > row.time + self.high:
            return False
        bad = _first(bads, (row.time, row.place))
        return bad is None or good <= bad

    def _forget(self) -> None:
        while self.rows and not _wanted(self.rows[0]):
            row = self.drop()
            for value in (row.left, row.right):
                if isinstance(value, FormulaCell) and value in self.waits:
                    self.waits[value] = [wait for wait in self.waits[value] if wait[0][1] > row.place]
                    if not self.waits[value]:
                        del self.waits[value]
        kept = self.rows[0].place if self.rows else self.run.place + 1
        for marks in (self.holds, self.hopes, self.fails, self.doubts, self.pending):
            while marks and marks[0][1] < kept:
                del marks[0]

    def pass_by(self, time: int) -> None:
        before, self.passed = self.passed, time
        self._look([(before - self.high + 1, 0)], [(time - self.high + 1, 0)])
        self._forget()

    @property
    def deadline(self) -> int | None:
        following = bisect_left(self.pending, (self.passed - self.high + 1, 0))
        while following < len(self.pending) and not _wanted(self.pending[following][2]):
            del self.pending[following]
        return self.pending[following][0] + self.high if following < len(self.pending) else None

    def save(self) -> tuple[object, ...]:
        return (
            self.rows, self.passed, self.pending, self.holds, self.hopes, self.fails, self.doubts, self.waits,
        )  # fmt: skip

    def restore(self, saved: tuple[Any, ...]) -> None:
        (
            self.rows, self.passed, self.pending, self.holds, self.hopes, self.fails, self.doubts, self.waits,
        ) = saved  # fmt: skip
        self.heard = []


def _first(kinds: _Marks, mark: _Mark) -> _Mark | None:
    found = ((marks, bisect_left(marks, mark)) for marks in kinds)
    return min((marks[index] for marks, index in found if index < len(marks)), default=None)


def _last(kinds: _Marks, mark: _Mark) -> _Mark | None:
    found = ((marks, bisect_left(marks, mark)) for marks in kinds)
    return max((marks[index - 1] for marks, index in found if index), default=None)


def _behind(mark: _Mark | None, low: int = 0) -> _Mark:
    return (-FOREVER, 0) if mark is None else (mark[0] - low, mark[1] + 1)


def _supposed(value: Value | None, *, hopeful: bool) -> bool:
    known = None if value is None else _known(value)
    return hopeful if known is None else known


class _OpenSince(_Rows):
    """`since` over values that may be open; `window` is its state before the rows.

    `least` is its state after the newest row if all open values fail, `most` if all hold.
    """

    def __init__(self, run: "BoundedRun", number: int, instruction: PastInstruction) -> None:
        super().__init__(run, number, instruction)
        self.window = SinceWindow(self.low, self.high)
        self.least, self.most = copy(self.window), copy(self.window)

    def take(self, now: int) -> None:
        self._judge(self.keep(now))
        self._forget()

    def settle(self) -> None:
        self.least, self.most = copy(self.window), copy(self.window)
        for row in self.rows:
            self._judge(row)
        self._forget()

    def _judge(self, row: _Row) -> None:
        sure, possible = (
            window.step(_supposed(row.left, hopeful=hopeful), _supposed(row.right, hopeful=hopeful), row.time)
            for window, hopeful in ((self.least, False), (self.most, True))
        )
        if sure is possible:
            self.run.decide(row.cell, sure)

    def _forget(self) -> None:
        while self.rows:
            row = self.rows[0]
            left, right = (None if value is None else _known(value) for value in (row.left, row.right))
            if left is None or right is None:
                break
            self.window.step(left, right, self.drop().time)

    def save(self) -> tuple[deque[_Row], SinceWindow, SinceWindow, SinceWindow]:
        return self.rows, self.window, self.least, self.most

    def restore(self, saved: tuple[deque[_Row], SinceWindow, SinceWindow, SinceWindow]) -> None:
        self.rows, self.window, self.least, self.most = saved


class _OpenPreviously(_Operator):
    before: Value = False
    time = -FOREVER

    def ask(self, now: int) -> Value:
        return self.before if self.low <= now - self.time <= self.high else False

    def take(self, now: int) -> None:
        _leave(self.before, self)
        self.before, self.time = self.run.value(self.left), now
        _use(self.before, self)

    def save(self) -> tuple[deque[_Row], Value, int]:
        return self.rows, self.before, self.time

    def restore(self, saved: tuple[deque[_Row], Value, int]) -> None:
        self.rows, self.before, self.time = saved


class _Next(_Operator):
    """`next`; `before` has the rows of the previous event, `rows` those of the current event."""

    def __init__(self, run: "BoundedRun", number: int, instruction: PastInstruction) -> None:
        super().__init__(run, number, instruction)
        self.before: deque[_Row] = deque()

    def take(self, now: int) -> None:
        before, self.before, self.rows = self.before, self.rows, deque()
        for row in before:
            if not _wanted(row) or row.cell is None:
                continue
            inside = self.low <= now - row.time <= self.high
            value = self.run.value(self.left) if inside else False
            if isinstance(value, FormulaCell):  # the value is open
                row.cell.stand_for("or", (value,))
            else:
                self.run.decide(row.cell, value)

    def pass_by(self, time: int) -> None:
        while self.before and self.before[0].time + self.high <= time:
            self.run.decide(self.before.popleft().cell, False)

    @property
    def deadline(self) -> int | None:
        return next((row.time + self.high for row in self.before if _wanted(row)), None)

    def save(self) -> tuple[deque[_Row], deque[_Row]]:
        return self.rows, self.before

    def restore(self, saved: tuple[deque[_Row], deque[_Row]]) -> None:
        self.rows, self.before = saved


class BoundedProperty(CompiledProperty):
    """A property for an mtl formula about the future, and perhaps the past."""

    timed = True
    most = MAX_OPEN

    def __init__(self, source: Source, formula: Formula) -> None:
        super().__init__(source, VERDICTS)
        self.program = program = PastProgram(formula, source.events)
        self.later: set[int] = set()
        for number, instruction in enumerate(program.instructions):
            if instruction.operator in _LATER or not self.later.isdisjoint(instruction.operands):
                self.later.add(number)
        asked = {operand for number in self.later for operand in program.instructions[number].operands}
        at_once = sorted(asked - self.later)
        self.folded = fold(program, at_once)
        self.at_once = {number: index for index, number in enumerate(at_once)}
        self.order = {
            number: sorted(program.instructions[number].operands, key=self.later.__contains__)
            for number in self.later
        }
        self._failing = self._decided_late()

    def start(self, time_ns: int) -> Run:
        return BoundedRun(self, time_ns)

    def operators(self, run: "BoundedRun") -> dict[int, _Operator]:
        operators: dict[int, _Operator] = {}
        for number in sorted(self.later, reverse=True):
            instruction = self.program.instructions[number]
            kind = _KINDS.get(instruction.operator)
            if instruction.operator == "until" and self.later.isdisjoint(instruction.operands):
                kind = _Until
            if kind is not None:
                operators[number] = kind(run, number, instruction)
        return operators

    def _decided_late(self) -> set[str]:
        signs: dict[int, set[bool]] = {self.program.result: {False}}
        for number in sorted(self.later, reverse=True):
            instruction = self.program.instructions[number]
            mine = signs.get(number, set())
            given = {"not": {not sign for sign in mine}, "xor": {False, True}}.get(instruction.operator, mine)
            for operand in instruction.operands:
                signs.setdefault(operand, set()).update(given)
        found = (
            signs[number] for number in self.later if self.program.instructions[number].operator in _LATER
        )
        return {VERDICTS[sign] for signs_of in found for sign in signs_of}

    def blocking_refused(self, category: str) -> str | None:
        super().blocking_refused(category)
        if category not in self._failing:
            return None
        return f"`{category}` may be decided when a time bound passes, long after the message to drop was passed on"


_CONTAINERS = (deque, list, dict, SinceWindow)

_KINDS: dict[str, type[_Operator]] = {
    "until": _OpenUntil,
    "since": _OpenSince,
    "previously": _OpenPreviously,
    "next": _Next,
}


_FORWARD = (_Until, _OpenUntil, _Next)


_RunMark = tuple[int, list[Any], list[tuple[object, ...]]]
"""The number of the event, the values of the part about the past, and the state of each operator."""


class BoundedRun(CostlyRun):
    """A run of a formula about the future."""

    def __init__(self, compiled: BoundedProperty, time_ns: int) -> None:
        self._compiled = compiled
        self._at_once = compiled.folded.start()
        self.later = compiled.later
        self.place = 0
        self.operators = compiled.operators(self)
        self._now = time_ns
        self._places: tuple[int, ...] = ()
        self._values: dict[int, Value] = {}
        self._decided: list[FormulaCell] = []
        self.changed: set[_Operator] = set()
        self.journal: Journal = {}
        self._told: dict[bool, int] = {}
        self._about: dict[bool, int] = {}
        self.work = 0

    @property
    def deadline(self) -> int | None:
        found = (operator.deadline for operator in self.operators.values())
        return min((deadline for deadline in found if deadline is not None), default=None)

    @property
    def as_new(self) -> bool:
        operators = self.operators.values()
        return (
            all(type(operator) in _FORWARD and not operator.rows for operator in operators)
            and self.deadline is None
            and self._at_once == self._compiled.folded.start()
        )

    @property
    def waiting(self) -> int:
        return sum(len(operator.rows) for operator in self.operators.values())

    def __copy__(self) -> "BoundedRun":
        program = self._compiled.program
        shared = (self._compiled, program, *program.instructions)
        return deepcopy(self, {id(one): one for one in shared})

    def step(self, event: int, time_ns: int) -> Categories:
        if self._now < time_ns:
            deadline = self.deadline
            if deadline is not None and time_ns > deadline:
                raise ValueError("the deadline has passed: expire the run first")
            self._now = time_ns
        waiting = self.waiting
        self.work = STEP_COST * waiting
        if waiting >= self._compiled.most:
            raise RunFaultError(f"more than {self._compiled.most} events wait for later events")
        self.place += 1
        self._places = self._compiled.folded.take(self._at_once, event, self._now)
        self._values = {}
        whole = self.value(self._compiled.program.result)
        if isinstance(whole, FormulaCell):
            whole.touch()
            whole.tells = self.place
        else:
            self._told[whole] = self.place
        for operator in self.operators.values():
            operator.take(self._now)
        return self._tell()

    def expire(self) -> Categories:
        deadline = self.deadline
        if deadline is None:
            raise ValueError("this run has no deadline")
        self._now = deadline
        for operator in self.operators.values():
            operator.pass_by(deadline)
        return self._tell()

    def mark(self) -> "_RunMark":
        self.journal.clear()
        operators = [
            tuple(copy(value) if isinstance(value, _CONTAINERS) else value for value in operator.save())
            for operator in self.operators.values()
        ]
        return self.place, list(map(copy, self._at_once)), operators

    def take_back(self, mark: "_RunMark") -> None:
        self.place, self._at_once, operators = mark
        for operator, before in zip(self.operators.values(), operators, strict=True):
            operator.restore(before)
        for cell, noted in self.journal.items():
            cell.restore(noted)
        self.journal.clear()

    def save(self) -> tuple[list[Any], int, int, dict[bool, int], dict[bool, int]]:
        return self._at_once, self.place, self._now, self._told, self._about

    def restore(self, saved: tuple[list[Any], int, int, dict[bool, int], dict[bool, int]]) -> None:
        self._at_once, self.place, self._now, self._told, self._about = saved

    def value(self, number: int) -> Value:
        index = self._compiled.at_once.get(number)
        if index is not None:
            return bool(self._at_once[self._places[index]])
        value = self._values.get(number)
        if value is None:
            value = self._values[number] = self._find(number)
        known = _known(value)
        return value if known is None else known

    def _find(self, number: int) -> Value:
        operator = self.operators.get(number)
        if operator is not None:
            return operator.ask(self._now)
        kind = self._compiled.program.instructions[number].operator
        absorbing = _ABSORBING.get(kind)
        operands = []
        for operand in self._compiled.order[number]:
            value = self.value(operand)
            if value is absorbing:
                return value
            operands.append(value)
        cell = FormulaCell(self.journal)
        cell.stand_for(kind, tuple(operands))
        return cell if cell.missing else _together(kind, cell.operands)

    def decide(self, cell: FormulaCell | None, value: bool) -> None:
        if cell is not None and cell.value is None:
            cell.touch()
            cell.value = value
            self._decided.append(cell)

    def _tell(self) -> Categories:
        while self._decided or self.changed:
            while self._decided:
                self._pass_on(self._decided.pop())
            if self.changed:
                innermost = min(self.changed, key=lambda operator: operator.number)
                self.changed.remove(innermost)
                innermost.settle()
        told, self._told = self._told, {}
        self._about = told
        return _CATEGORIES[False in told, True in told]

    def about(self, category: str) -> int:
        return self._about[category == VERDICTS[True]]

    def _pass_on(self, cell: FormulaCell) -> None:
        assert cell.value is not None  # noqa: S101  the cell was decided
        cell.touch()
        if cell.tells:
            self._told[cell.value] = cell.tells
        for user in cell.users:
            if not isinstance(user, FormulaCell):
                user.hear(cell)
                self.changed.add(user)
            elif user.wanted:  # another user may just have decided this value
                value = user.hear(cell.value)
                if value is not None:
                    self.decide(user, value)
                    for operand in user.operands:
                        _leave(operand, user)
        cell.users, cell.operands = [], ()


_CATEGORIES: dict[tuple[bool, bool], Categories] = {
    (False, False): (),
    (True, False): VERDICTS[:1],
    (False, True): VERDICTS[1:],
    (True, True): VERDICTS,
}

PARTS: Mapping[str, type] = {"cell": FormulaCell, "row": _Row, "window": SinceWindow}
