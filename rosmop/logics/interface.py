"""The interface of every logic to the compiler of ``.rv`` files and to the relay.

Contract for the caller of a run:

1. ``property.start(now)`` returns a fresh run. ``now`` is the time when monitoring begins, or when ``__RESET;`` took
effect.
2. Before a step at time ``t``: while ``run.deadline`` is not None and ``run.deadline < t``, call ``run.expire()``. An
event exactly at the deadline is in time, so a deadline expires only when no event at or before it can still come. The
expiry takes effect at the deadline.
3. ``run.step(event, t)`` returns the categories after the event. Their handlers run in this order. ``run.expire()``
does the same, and has ``timeout`` before the new state.
4. Times are integer nanoseconds and never decrease: an earlier time than the last counts as the last time.
5. A `FormulaRun` can undo a dropped message: call `mark` before its first step, and `take_back` with that mark if it
is dropped. The time is not undone. No deadline expires between the two calls.
6. If a step raises `RunFaultError`, only the time of the run has changed.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, Self

from rosmop.form.findings import Diagnostic, Position
from rosmop.logics.automaton import Automaton

Categories = tuple[str, ...]


class FormulaError(Exception):
    """A rejected formula: the reasons, their positions, and the remedies."""

    def __init__(self, findings: Sequence[Diagnostic]) -> None:
        super().__init__("; ".join(str(finding) for finding in findings))
        self.findings = tuple(findings)


class RunFaultError(Exception):
    """A step needs more memory or work than a run may have."""


class Run(Protocol):
    """One run of a property; the head of this module has the contract. A copy (`copy.copy`) is an independent run."""

    @property
    def as_new(self) -> bool:
        """Whether the run will behave like a fresh run; False if this is not known."""

    @property
    def deadline(self) -> int | None:
        """Return the last time (ns) at which an event is in time, or None if the run waits for nothing."""

    def step(self, event: int, time_ns: int) -> Categories: ...

    def expire(self) -> Categories:
        """Call this only while ``deadline`` is not None."""

    def save(self) -> tuple[object, ...]:
        """Return the values that change (`state_of_runs.py`)."""

    def restore(self, saved: tuple[Any, ...]) -> None:
        """Restore such values in a fresh run."""


class FormulaRun(Run, Protocol):
    """A run of a property that `suppresses`."""

    def mark(self) -> Any:
        """Return the data that `take_back` needs; earlier marks become invalid."""

    def take_back(self, mark: Any) -> None:
        """Undo the steps since the mark, but keep the time. A mark can be used once."""


@dataclass(frozen=True)
class Source:
    """A formula as written, and its events in the order of the specification."""

    logic: str
    text: str
    events: tuple[str, ...]
    origin: Position
    suppresses: bool = False
    times: Mapping[str, int] = field(default_factory=dict, compare=False)

    def finding(self, offset: int, text: str) -> Diagnostic:
        return Diagnostic(self.origin.within(self.text, min(offset, len(self.text))), "error", text)

    def error(self, offset: int, text: str) -> FormulaError:
        return FormulaError([self.finding(offset, text)])


class CompiledProperty(ABC):
    """A compiled property; ``categories`` are the names that may have handlers."""

    timed = False

    expiry = "deadline"

    made_of: tuple[object, ...]

    @property
    def suppresses(self) -> bool:
        return self.source.suppresses

    remedy: str | None = None

    def __new__(cls, *made_of: object) -> Self:
        made = super().__new__(cls)
        made.made_of = made_of
        return made

    def __init__(self, source: Source, categories: Sequence[str]) -> None:
        self.source = source
        self.logic = source.logic
        self.formula = source.text
        self.events = source.events
        self.categories: Categories = tuple(categories)

    @abstractmethod
    def start(self, time_ns: int) -> Run: ...

    def categories_after(self, event: int) -> frozenset[str]:
        """Return all categories that this event can lead to, and perhaps more."""
        return frozenset(self.categories) if 0 <= event < len(self.events) else frozenset()

    def blocking_refused(self, category: str) -> str | None:
        """Return the reason why a handler may not drop the message, or None if it may."""
        if category not in self.categories:
            raise KeyError(category)
        return None


class FiniteProperty(CompiledProperty):
    """A property whose monitor is a finite automaton; a fresh run is in ``automaton.initial``."""

    def __init__(self, source: Source, categories: Sequence[str], automaton: Automaton) -> None:
        super().__init__(source, categories)
        self.automaton = automaton

    def start(self, _time_ns: int) -> Run:
        return FiniteRun(self.automaton)

    def categories_after(self, event: int) -> frozenset[str]:
        verdicts = self.automaton.verdicts
        return frozenset(name for row in self.automaton.table for name in verdicts[row[event]])


class UntimedRun:
    """A run without deadlines."""

    __slots__ = ()

    deadline: int | None = None

    @property
    def as_new(self) -> bool:
        return False

    def expire(self) -> Categories:
        raise ValueError("this run has no deadline")


class CostlyRun:
    """A run whose steps take longer than a few instructions: `work` is the number for the last one."""

    __slots__ = ()

    work: int


class FiniteRun(UntimedRun):
    """Walks the tables of an automaton."""

    __slots__ = ("_automaton", "state")

    def __init__(self, automaton: Automaton) -> None:
        self._automaton = automaton
        self.state = automaton.initial

    def __copy__(self) -> "FiniteRun":
        made = FiniteRun(self._automaton)
        made.state = self.state
        return made

    @property
    def as_new(self) -> bool:
        return self.state == self._automaton.initial

    def step(self, event: int, _time_ns: int) -> Categories:
        self.state = self._automaton.table[self.state][event]
        return self._automaton.verdicts[self.state]

    def mark(self) -> int:
        return self.state

    def take_back(self, mark: int) -> None:
        self.state = mark

    def save(self) -> tuple[int]:
        return (self.state,)

    def restore(self, saved: tuple[int]) -> None:
        (self.state,) = saved


Move = tuple[int, bool]


class Wait(NamedTuple):
    """The move and the categories after ``after`` nanoseconds on the clock."""

    after: int
    move: Move
    categories: Categories


class ClockedProperty(CompiledProperty):
    """A property whose monitor is an automaton with one clock.

    ``moves[state][event]`` is the move at an event; ``late`` has the moves at events more than ``within`` ns after
    the clock started. ``verdicts`` are the categories after an event that leads to a state.
    """

    timed = True
    initial: int
    moves: Sequence[Sequence[Move]]
    late: Sequence[Sequence[Move]]
    within: int
    verdicts: Sequence[Categories]
    waits: Sequence[Wait | None]

    def start(self, time_ns: int) -> Run:
        return ClockedRun(self, time_ns)


class ClockedRun:
    """A run of a `ClockedProperty`."""

    __slots__ = ("_tables", "now", "since", "state")

    def __init__(self, tables: ClockedProperty, time_ns: int) -> None:
        self._tables = tables
        self.state = tables.initial
        self.now = self.since = time_ns

    def __copy__(self) -> "ClockedRun":
        made = ClockedRun(self._tables, self.now)
        made.state, made.since = self.state, self.since
        return made

    @property
    def deadline(self) -> int | None:
        wait = self._tables.waits[self.state]
        return None if wait is None else self.since + wait.after

    @property
    def as_new(self) -> bool:
        """Whether the run is in its initial state, in which the clock does not matter."""
        state, tables = self.state, self._tables
        return (
            state == tables.initial
            and tables.waits[state] is None
            and tables.moves[state] == tables.late[state]
        )

    def step(self, event: int, time_ns: int) -> Categories:
        tables = self._tables
        if time_ns > self.now:
            deadline = self.deadline
            if deadline is not None and time_ns > deadline:
                raise ValueError("the deadline has passed: expire the run first")
            self.now = time_ns
        moves = tables.late if self.now - self.since > tables.within else tables.moves
        self._move(moves[self.state][event])
        return tables.verdicts[self.state]

    def expire(self) -> Categories:
        wait = self._tables.waits[self.state]
        if wait is None:
            raise ValueError("this run has no deadline")
        self.now = self.since + wait.after
        self._move(wait.move)
        return wait.categories

    def mark(self) -> tuple[int, int]:
        return self.state, self.since

    def take_back(self, mark: tuple[int, int]) -> None:
        self.state, self.since = mark

    def save(self) -> tuple[int, int, int]:
        return self.state, self.since, self.now

    def restore(self, saved: tuple[int, int, int]) -> None:
        self.state, self.since, self.now = saved

    def _move(self, move: Move) -> None:
        self.state, restarts = move
        if restarts:
            self.since = self.now


Compiler = Callable[[Source], CompiledProperty]


@dataclass(frozen=True)
class Logic:
    """A logic, with facts that other parts of the language need."""

    compile: Compiler
    properties: tuple[type[CompiledProperty], ...] = (FiniteProperty,)
    suppresses: bool = False
    """Whether a dropped message does not count. Other logics count each event whose action passes the message."""
    failure: str | None = None
    """The category of failure: `check` warns about a property that always fails at the first event."""
    has_states: bool = False
    implicit_events: tuple[str, ...] = ()
