"""What every logic offers to the compiler of ``.rv`` files and to the relay.

A logic turns a formula and the events of its specification into a ``CompiledProperty``. The property names
the *categories* that may have handlers, and starts *runs*; a run is stepped with one event after the other
and says after each step which categories the property is in, so that the caller runs their handlers.

Theory of operation for the caller of a run:

1. ``property.start(now)`` gives a fresh run. ``now`` is when monitoring begins, or when ``__RESET;`` took
   effect.
2. Before a step at time ``t``: while ``run.deadline`` is not None and ``run.deadline < t``, call
   ``run.expire()``. A bound is closed: an event exactly at the deadline is in time, so an expiry happens
   only once it is certain that no event at or before the deadline will come. It takes effect at the
   deadline.
3. ``run.step(event, t)`` returns the categories after the event, in the order in which they are to be told.
   After ``expire()`` handlers of the first category named run first (``timeout`` before the state entered).
4. Times are integer nanoseconds and never run backwards; a time before the last one counts as the last one.
5. Of a `FormulaRun`, `mark` before the first step of a message and `take_back` of that mark when the message is dropped
   make it as if the message had not come; its time has passed all the same. No deadline expires between the two.

A ``FiniteProperty`` and a ``ClockedProperty`` offer their tables as well, so that a module can step them.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, Self

from rosmop.form.positions import Finding, Position
from rosmop.logics.automaton import Automaton

Categories = tuple[str, ...]


class FormulaError(Exception):
    """A formula that cannot be accepted: what is wrong with it, where, and what to write instead."""

    def __init__(self, findings: Sequence[Finding]) -> None:
        super().__init__("; ".join(str(finding) for finding in findings))
        self.findings = tuple(findings)


class RunFaultError(Exception):
    """A run cannot go on, because the trace asks for more memory than a run may have."""


class Run(Protocol):
    """One run of a property over a trace; see the head of this module for the contract. A copy (`copy.copy`) goes on
    by itself; a run that has no `__copy__` has none. `keeps` names the attributes that change (`kept_runs.py`).
    """

    @property
    def as_new(self) -> bool:
        """Whether it goes on as a run that begins now would; where that is not known, False."""

    @property
    def deadline(self) -> int | None:
        """The last instant (ns) at which an event is in time, or None if the run waits for nothing."""

    def step(self, event: int, time_ns: int) -> Categories:
        """Take the event with this index, received at ``time_ns``; return the categories the property is
        in."""

    def expire(self) -> Categories:
        """Let the deadline pass; return the categories that follow. Only while ``deadline`` is not None."""


class FormulaRun(Run, Protocol):
    """The run of a property that `suppresses`: its steps can be taken back."""

    def mark(self) -> Any:
        """Return what `take_back` needs to undo the steps from here on; an earlier mark is void then."""

    def take_back(self, mark: Any) -> None:
        """Undo the steps since the mark, but keep the time. A mark serves once."""


FORMULAS = frozenset({"ltl", "ptltl", "mtl", "pattern"})
"""The logics for which a dropped message has not happened; the others count each event whose action lets it pass."""


def twin(run: Any) -> Any:
    """A copy of a run whose attributes are replaced and never changed in place: its `__copy__`."""
    made = object.__new__(type(run))
    for name in run.__slots__:
        setattr(made, name, getattr(run, name))
    return made


@dataclass(frozen=True)
class Source:
    """A formula as it stands in the file, and the events (its alphabet) in the order of the specification."""

    logic: str
    text: str
    events: tuple[str, ...]
    origin: Position

    def finding(self, offset: int, text: str) -> Finding:
        """An error at the given character of the formula."""
        return Finding(self.origin.within(self.text, min(offset, len(self.text))), "error", text)

    def error(self, offset: int, text: str) -> FormulaError:
        """The refusal of this formula for one reason."""
        return FormulaError([self.finding(offset, text)])


class CompiledProperty(ABC):
    """A property ready to run. ``categories`` are the names that may have handlers."""

    timed = False
    """Whether verdicts depend on the time of events (a run that is not timed never has a deadline)."""

    expiry = "deadline"
    """What the passing of a run's deadline is called in records (``timeout`` for machines)."""

    made_of: tuple[Any, ...]
    """What it was made of: all that another process needs to make the same."""

    @property
    def suppresses(self) -> bool:
        """Whether a dropped message has not happened for it: a run takes back the steps that the message made."""
        return self.logic in FORMULAS

    remedy: str | None = None
    """The function of the specification that publishes what was due when a deadline passes (`enforced by`)."""

    def __new__(cls, *made_of: Any) -> Self:
        """Keep what it is made of."""
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
    def start(self, time_ns: int) -> Run:
        """A fresh run that begins at ``time_ns``."""

    def categories_after(self, event: int) -> frozenset[str]:
        """The categories a step with this event can lead to; may name too many, never too few."""
        return frozenset(self.categories) if 0 <= event < len(self.events) else frozenset()

    def blocking_refused(self, category: str) -> str | None:
        """Why a handler of this category may not drop the message, or None if it may (it is enforceable)."""
        if category not in self.categories:
            raise KeyError(category)
        return None


class FiniteProperty(CompiledProperty):
    """A property whose monitor is a finite automaton.

    ``automaton.table[state][event]`` is the next state, ``automaton.verdicts[state]`` the categories after
    a step into ``state``, ``automaton.initial`` the state of a fresh run.
    """

    def __init__(self, source: Source, categories: Sequence[str], automaton: Automaton) -> None:
        super().__init__(source, categories)
        self.automaton = automaton

    def start(self, _time_ns: int) -> Run:
        """A fresh run; the time plays no part."""
        return FiniteRun(self.automaton)

    def categories_after(self, event: int) -> frozenset[str]:
        """The categories of the states this event leads to."""
        verdicts = self.automaton.verdicts
        return frozenset(name for row in self.automaton.table for name in verdicts[row[event]])


class UntimedRun:
    """What runs that wait for nothing have in common."""

    __slots__ = ()

    deadline: int | None = None

    @property
    def as_new(self) -> bool:
        """Not known."""
        return False

    def expire(self) -> Categories:
        """Never right: there is no deadline."""
        raise ValueError("this run has no deadline")


class FiniteRun(UntimedRun):
    """A run over the tables of an automaton."""

    __slots__ = ("_automaton", "state")
    keeps = ("state",)
    __copy__ = twin

    def __init__(self, automaton: Automaton) -> None:
        self._automaton = automaton
        self.state = automaton.initial

    @property
    def as_new(self) -> bool:
        """Whether it is in the initial state."""
        return self.state == self._automaton.initial

    def step(self, event: int, _time_ns: int) -> Categories:
        """Take the event; the time plays no part."""
        self.state = self._automaton.table[self.state][event]
        return self._automaton.verdicts[self.state]

    def mark(self) -> int:
        """The state."""
        return self.state

    def take_back(self, mark: int) -> None:
        """Return to it."""
        self.state = mark


Move = tuple[int, bool]
"""The next state, and whether the clock begins anew."""


class Wait(NamedTuple):
    """What a state waits for: how long (ns) after the clock began its deadline is, and what follows then."""

    after: int
    move: Move
    told: Categories


class ClockedProperty(CompiledProperty):
    """A property whose monitor is an automaton with one clock.

    ``moves[state][event]`` is the move at an event, ``late`` the same where more than ``within`` (ns) has passed since
    the clock began. ``verdicts`` are the categories after an event that leads to a state, ``waits`` what it waits for.
    """

    timed = True
    initial: int
    moves: Sequence[Sequence[Move]]
    late: Sequence[Sequence[Move]]
    within: int
    verdicts: Sequence[Categories]
    waits: Sequence[Wait | None]

    def start(self, time_ns: int) -> Run:
        """A run whose clock begins at ``time_ns``."""
        return ClockedRun(self, time_ns)


class ClockedRun:
    """A run over such tables: the state, when its clock began, and the time."""

    __slots__ = ("_tables", "now", "since", "state")
    keeps = ("state", "since", "now")
    __copy__ = twin

    def __init__(self, tables: ClockedProperty, time_ns: int) -> None:
        self._tables = tables
        self.state = tables.initial
        self.now = self.since = time_ns

    @property
    def deadline(self) -> int | None:
        """When the wait of the state is over."""
        wait = self._tables.waits[self.state]
        return None if wait is None else self.since + wait.after

    @property
    def as_new(self) -> bool:
        """Whether it is in the initial state, and the clock plays no part there."""
        state, tables = self.state, self._tables
        return (
            state == tables.initial
            and tables.waits[state] is None
            and tables.moves[state] == tables.late[state]
        )

    def step(self, event: int, time_ns: int) -> Categories:
        """Take the event."""
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
        """Let the deadline pass."""
        wait = self._tables.waits[self.state]
        if wait is None:
            raise ValueError("this run has no deadline")
        self.now = self.since + wait.after
        self._move(wait.move)
        return wait.told

    def mark(self) -> tuple[int, int]:
        """The state, and when its clock began."""
        return self.state, self.since

    def take_back(self, mark: tuple[int, int]) -> None:
        """Return to these; `now` stays."""
        self.state, self.since = mark

    def _move(self, move: Move) -> None:
        self.state, restarts = move
        if restarts:
            self.since = self.now


Compiler = Callable[[Source], CompiledProperty]
