"""Monitors for formulas that look into the future within bounds of time: the other part of mtl.

The formula is asked at every event, and the answer for an event is told once it is certain: by an event, or when a
bound passes. What is certain is found part by part: `x or y` is once one of them is, `x until[l,h] y` once `y` has
come in time and `x` held until then, or `x` has failed, or the time is over.

Theory of operation. A `Program` (`past.py`) has the distinct parts of the formula. Those that look back only are
computed at their event (`Folded`). Of the others a *cell* stands for the value of one part at one event
while that is open; a cell tells its *users* when it is decided. Cells are made for what is asked for only: of
`fire => eventually[0,1s] safe` nothing is kept but the events `fire` that wait.

- `until` over parts that are known at once keeps the events asked about in order, and decides them from the oldest on:
  a step costs the same however many wait.
- `until` and `since` over parts that are open themselves keep *rows*, one for each event that matters. What is certain
  is what comes out alike whether all that is open were to fail or to hold (both operators only gain when a part comes
  to hold); so it is computed twice, over all rows, when a part is decided that was open.

A run waits for at most `MOST_OPEN` events; a step beyond that is a fault, and its event is not seen.
"""

from abc import ABC, abstractmethod
from bisect import bisect_right
from collections import deque
from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass

from appliance.rosmop.logics.formula import Formula
from appliance.rosmop.logics.interface import Categories, CompiledProperty, Run, RunFaultError, Source
from appliance.rosmop.logics.past import FOREVER, VERDICTS, Instruction, Program, Window, fold

MOST_OPEN = 10_000

_LATER = ("until", "next")


class Cell:
    """The value of a part at an event that is not decided yet; `tells`: the part is the whole formula, at this event
    (`BoundedRun.place`; 0: it is not the whole).

    The value of a `kind` (`and`, `or`, `xor`, `not`) comes from `operands`, of which `missing` are open.
    """

    __slots__ = ("kind", "missing", "operands", "tells", "users", "value")

    def __init__(self) -> None:
        self.users: list[Cell | _Operator] = []
        self.tells = 0
        self.value: bool | None = None
        self.stand_for("", ())

    def stand_for(self, kind: str, operands: tuple["Value", ...]) -> None:
        """Take the value from these."""
        self.kind, self.operands = kind, operands
        self.missing = sum(_use(operand, self) for operand in operands)

    @property
    def wanted(self) -> bool:
        """Whether it is open, and somebody waits for it."""
        return self.value is None and bool(self.tells or self.users)

    def hear(self, value: bool) -> bool | None:
        """What it is worth now that one more operand has this value; None: that is still open."""
        self.missing -= 1
        if self.kind == "not":
            return not value
        if value is _ABSORBING.get(self.kind):
            return value
        return None if self.missing else _together(self.kind, self.operands)


Value = bool | Cell


def _known(value: Value) -> bool | None:
    return value.value if isinstance(value, Cell) else value


def _use(value: Value, user: "Cell | _Operator") -> bool:
    """Whether the value is open; its user is told then."""
    if isinstance(value, Cell) and value.value is None:
        value.users.append(user)
        return True
    return False


def _leave(value: Value, user: "Cell | _Operator") -> None:
    """The user waits no more; what only it waited for is not waited for either."""
    waiting = [(value, user)]
    while waiting:
        left, leaver = waiting.pop()
        if isinstance(left, Cell) and left.value is None:
            left.users.remove(leaver)
            if not left.wanted:
                waiting += [(operand, left) for operand in left.operands]


_ABSORBING = {"and": False, "or": True}


def _together(kind: str, operands: tuple[Value, ...]) -> bool:
    """The value of operands that are all known, none of them absorbing."""
    if kind == "xor":
        return sum(map(bool, map(_known, operands))) % 2 == 1
    return bool(_known(operands[0])) is not (kind == "not")


@dataclass(eq=False, slots=True)
class _Row:
    """An event that an operator keeps: its time, what its operands are worth at it, and what it was asked for."""

    place: int
    time: int
    left: Value | None
    right: Value | None
    cell: Cell | None


class _Operator(ABC):
    """An operator in a run. `ask` comes before `take` for each event, and `pass_by` between events."""

    def __init__(self, run: "BoundedRun", number: int, instruction: Instruction) -> None:
        self.run, self.number = run, number
        self.left, self.right = instruction.operands[0], instruction.operands[-1]
        self.low, self.high = instruction.low, FOREVER if instruction.high is None else instruction.high
        self.rows: deque[_Row] = deque()

    def ask(self, now: int) -> Value:
        """Its value at the event that happens now."""
        self.rows.append(_Row(self.run.place, now, None, None, Cell()))
        return self.rows[-1].cell or False

    @abstractmethod
    def take(self, now: int) -> None:
        """Look at the event."""

    def settle(self) -> None:  # noqa: B027  two have open operands, and something to decide then
        """Decide what can be, now that operands are decided."""

    def hear(self, value: bool) -> None:
        """An operand that was open has this value; `settle` is called for all such together."""
        del value

    def pass_by(self, time: int) -> None:
        """There will be no event any more up to this time."""
        del time

    @property
    def deadline(self) -> int | None:
        """When a bound passes on which something depends."""
        return None


class _Until(_Operator):
    """`until` over what is known at once."""

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


class _Rows(_Operator):
    """An operator that keeps what its operands are worth."""

    def keep(self, now: int) -> _Row:
        """The row of the event that happens now."""
        if not self.rows or self.rows[-1].left is not None:
            self.rows.append(_Row(self.run.place, now, None, None, None))
        row = self.rows[-1]
        row.left, row.right = self.run.value(self.left), self.run.value(self.right)
        _use(row.left, self)
        _use(row.right, self)
        return row

    def drop(self) -> _Row:
        """Keep the oldest row no longer."""
        row = self.rows.popleft()
        for value in (row.left, row.right):
            if value is not None:
                _leave(value, self)
        return row


class _OpenUntil(_Rows):
    """`until` over what may be open. All time up to `passed` is over.

    `hopes` are the rows at which the right operand may still come. As long as it has come at no row, and the left one
    has failed at none (`noted`), a row is decided only when its time is over and nothing in it may come any more.
    """

    def __init__(self, run: "BoundedRun", number: int, instruction: Instruction) -> None:
        super().__init__(run, number, instruction)
        self.passed = -FOREVER
        self.hopes: deque[_Row] = deque()
        self.noted = False

    def take(self, now: int) -> None:
        if not self.rows:
            return
        row = self.keep(now)
        if isinstance(row.right, Cell):
            self.hopes.append(row)
        if row.right is True or row.left is False:
            self.noted = True
            self.run.changed.add(self)

    def hear(self, value: bool) -> None:
        self.noted |= value or self.left in self.run.later

    def settle(self) -> None:
        if self.noted:
            least, most = self._values(hopeful=False), self._values(hopeful=True)
            for row in reversed(self.rows):
                sure, possible = next(least), next(most)
                if sure is possible:
                    self.run.decide(row.cell, sure)
        else:
            self._close()
        while self.rows and not _wanted(self.rows[0]):
            self.drop()
        if self.noted:
            self.noted = any(
                _supposed(row.right, hopeful=False) or not _supposed(row.left, hopeful=True)
                for row in self.rows
            )

    def _close(self) -> None:
        """Decide the rows whose time is over, where nothing may come any more."""
        while self.hopes and _known(self.hopes[0].right or False) is not None:
            self.hopes.popleft()
        for row in self.rows:
            if row.time + self.high > self.passed:
                break
            if not any(self._may_come(row, hope) for hope in self.hopes):
                self.run.decide(row.cell, False)

    def _may_come(self, row: _Row, hope: _Row) -> bool:
        inside = self.low <= hope.time - row.time <= self.high and hope.place >= row.place
        return inside and _known(hope.right or False) is None

    def _values(self, *, hopeful: bool) -> Iterator[bool]:
        """What it is worth from the newest row to the oldest if all that is open were to hold, or to fail."""
        # The times at which the right operand holds, negated, as far as the left one reaches.
        goods: list[int] = []
        onward = hopeful
        for row in reversed(self.rows):
            left, right = (_supposed(value, hopeful=hopeful) for value in (row.left, row.right))
            if not left:
                goods.clear()
                onward = False
            if right:
                goods.append(-row.time)
            first = bisect_right(goods, -(row.time + self.low)) - 1
            found = first >= 0 and -goods[first] <= row.time + self.high
            yield found or (onward and row.time + self.high > self.passed)

    def pass_by(self, time: int) -> None:
        self.passed = time
        self.settle()

    @property
    def deadline(self) -> int | None:
        return next(
            (
                row.time + self.high
                for row in self.rows
                if row.time + self.high > self.passed and _wanted(row)
            ),
            None,
        )


def _supposed(value: Value | None, *, hopeful: bool) -> bool:
    known = None if value is None else _known(value)
    return hopeful if known is None else known


class _OpenSince(_Rows):
    """`since` over what may be open; `window` is where the rows begin.

    `least` and `most` are behind the newest row, if all that is open were to fail, or to hold.
    """

    def __init__(self, run: "BoundedRun", number: int, instruction: Instruction) -> None:
        super().__init__(run, number, instruction)
        self.window = Window(self.low, self.high)
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


class _OpenPreviously(_Operator):
    """`previously` of what may be open: what that was at the event before."""

    before: Value = False
    time = -FOREVER

    def ask(self, now: int) -> Value:
        return self.before if self.low <= now - self.time <= self.high else False

    def take(self, now: int) -> None:
        _leave(self.before, self)
        self.before, self.time = self.run.value(self.left), now
        _use(self.before, self)


class _Next(_Operator):
    """`next`: the rows ask about the event before; `fresh` are those of the event that happens now."""

    def __init__(self, run: "BoundedRun", number: int, instruction: Instruction) -> None:
        super().__init__(run, number, instruction)
        self.before: deque[_Row] = deque()

    def take(self, now: int) -> None:
        before, self.before, self.rows = self.before, self.rows, deque()
        for row in before:
            if not _wanted(row) or row.cell is None:
                continue
            inside = self.low <= now - row.time <= self.high
            value = self.run.value(self.left) if inside else False
            if isinstance(value, Cell):  # it is open
                row.cell.stand_for("or", (value,))
            else:
                self.run.decide(row.cell, value)

    def pass_by(self, time: int) -> None:
        while self.before and self.before[0].time + self.high <= time:
            self.run.decide(self.before.popleft().cell, False)

    @property
    def deadline(self) -> int | None:
        return next((row.time + self.high for row in self.before if _wanted(row)), None)


class BoundedProperty(CompiledProperty):
    """A formula of mtl about the future, and perhaps the past."""

    timed = True

    def __init__(self, source: Source, formula: Formula) -> None:
        super().__init__(source, VERDICTS)
        self.program = program = Program(formula, source.events)
        self.later: set[int] = set()
        """The instructions whose value may come after their event."""
        for number, instruction in enumerate(program.instructions):
            if instruction.operator in _LATER or not self.later.isdisjoint(instruction.operands):
                self.later.add(number)
        asked = {operand for number in self.later for operand in program.instructions[number].operands}
        at_once = sorted(asked - self.later)
        self.folded = fold(program, at_once)
        self.at_once = {number: index for index, number in enumerate(at_once)}
        """Those that these need to know at their event, as `folded` has them."""
        self.order = {
            number: sorted(program.instructions[number].operands, key=self.later.__contains__)
            for number in self.later
        }
        self._failing = self._decided_late()

    def start(self, time_ns: int) -> Run:
        """A fresh run."""
        return BoundedRun(self, time_ns)

    def operators(self, run: "BoundedRun") -> dict[int, _Operator]:
        """Those whose values may come later, for a run; the outermost first."""
        found: dict[int, _Operator] = {}
        for number in sorted(self.later, reverse=True):
            instruction = self.program.instructions[number]
            kind = _KINDS.get(instruction.operator)
            if instruction.operator == "until" and self.later.isdisjoint(instruction.operands):
                kind = _Until
            if kind is not None:
                found[number] = kind(run, number, instruction)
        return found

    def _decided_late(self) -> set[str]:
        """The verdicts that the passing of a bound may bring: then an `until` or `next` fails, nothing else.

        So it is `violation` where one stands that the formula needs, `validation` where one that it must not have.
        """
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
        """What a deadline decides is decided when no message comes."""
        super().blocking_refused(category)
        if category not in self._failing:
            return None
        return (
            f"`{category}` may come when a bound of time passes, and the message that would have to be stopped has"
            " long been passed on then"
        )


_KINDS: dict[str, type[_Operator]] = {
    "until": _OpenUntil,
    "since": _OpenSince,
    "previously": _OpenPreviously,
    "next": _Next,
}


class BoundedRun:
    """A run of a formula about the future."""

    def __init__(self, compiled: BoundedProperty, time_ns: int) -> None:
        self._compiled = compiled
        self._at_once = compiled.folded.start()
        self.later = compiled.later
        self.place = 0
        self._operators = compiled.operators(self)
        self._now = time_ns
        self._places: tuple[int, ...] = ()
        self._values: dict[int, Value] = {}
        self._decided: list[Cell] = []
        self.changed: set[_Operator] = set()
        self._told: dict[bool, int] = {}
        self._about: dict[bool, int] = {}

    @property
    def deadline(self) -> int | None:
        """When the first bound passes on which a verdict depends."""
        found = (operator.deadline for operator in self._operators.values())
        return min((deadline for deadline in found if deadline is not None), default=None)

    def step(self, event: int, time_ns: int) -> Categories:
        """Take the event."""
        if self._now < time_ns:
            deadline = self.deadline
            if deadline is not None and time_ns > deadline:
                raise ValueError("the deadline has passed: expire the run first")
            self._now = time_ns
        if sum(len(operator.rows) for operator in self._operators.values()) >= MOST_OPEN:
            raise RunFaultError(f"more than {MOST_OPEN} events wait for what follows them")
        self.place += 1
        self._places = self._compiled.folded.take(self._at_once, event, self._now)
        self._values = {}
        whole = self.value(self._compiled.program.result)
        if isinstance(whole, Cell):
            whole.tells = self.place
        else:
            self._told[whole] = self.place
        for operator in self._operators.values():
            operator.take(self._now)
        return self._tell()

    def expire(self) -> Categories:
        """Let the deadline pass."""
        deadline = self.deadline
        if deadline is None:
            raise ValueError("this run has no deadline")
        self._now = deadline
        for operator in self._operators.values():
            operator.pass_by(deadline)
        return self._tell()

    def value(self, number: int) -> Value:
        """What an instruction is worth at the event that happens now: a cell only while it is open."""
        index = self._compiled.at_once.get(number)
        if index is not None:
            return bool(self._at_once[self._places[index]])
        value = self._values.get(number)
        if value is None:
            value = self._values[number] = self._find(number)
        known = _known(value)
        return value if known is None else known

    def _find(self, number: int) -> Value:
        operator = self._operators.get(number)
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
        cell = Cell()
        cell.stand_for(kind, tuple(operands))
        return cell if cell.missing else _together(kind, cell.operands)

    def decide(self, cell: Cell | None, value: bool) -> None:
        """The value of a cell is known (None: nobody has asked)."""
        if cell is not None and cell.value is None:
            cell.value = value
            self._decided.append(cell)

    def _tell(self) -> Categories:
        """Let everybody know what is decided; the verdicts that come of it."""
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
        """At which event, counted from 1, the formula is what the last step or deadline told."""
        return self._about[category == VERDICTS[True]]

    def _pass_on(self, cell: Cell) -> None:
        assert cell.value is not None  # noqa: S101  it was decided
        if cell.tells:
            self._told[cell.value] = cell.tells
        for user in cell.users:
            if not isinstance(user, Cell):
                user.hear(cell.value)
                self.changed.add(user)
            elif user.wanted:  # another user may have decided it a moment ago
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
