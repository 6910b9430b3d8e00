"""``tfsm``: state machines with time bounds.

``s1 [ b -> s0, timeout 2s -> late ]``: after 2 s in ``s1`` without an event the machine moves to ``late``.
The category ``timeout`` is that of having moved so; it is told before those of the state entered. The new
state counts as entered at the deadline, not when somebody looked. Every event of the specification starts
the clock of the state it leads to.

A machine without any timeout clause behaves as MOP's: the category ``timeout`` is told once whenever one
second passes after an event without another; the state stays.
"""

from appliance.rosmop.logics.automaton import Automaton
from appliance.rosmop.logics.fsm import FAIL, TIMEOUT, machine_automaton, read_machine
from appliance.rosmop.logics.interface import Categories, CompiledProperty, Run, Source, twin

SILENCE_NS = 10**9
"""How long a machine without timeout clauses waits for the next event."""


class TimedMachine(CompiledProperty):
    """A compiled ``tfsm``.

    ``automaton`` has the transitions on events; ``timeouts[state]`` is (nanoseconds, next state) or None.
    With ``silence_ns`` set there are no timeout clauses, and the clock runs after each event.
    """

    expiry = TIMEOUT

    def __init__(
        self,
        source: Source,
        categories: list[str],
        automaton: Automaton,
        timeouts: tuple[tuple[int, int] | None, ...],
    ) -> None:
        super().__init__(source, categories)
        self.automaton = automaton
        self.timeouts = timeouts
        self.silence_ns = None if any(timeouts) else SILENCE_NS

    @property
    def timed(self) -> bool:
        """Always."""
        return True

    def start(self, time_ns: int) -> Run:
        """A run whose initial state is entered at ``time_ns``."""
        return _ClockRun(self, time_ns) if self.silence_ns is None else _SilenceRun(self, time_ns)

    def categories_after(self, event: int) -> frozenset[str]:
        """The categories of the states this event leads to (``timeout`` needs no event)."""
        verdicts = self.automaton.verdicts
        return frozenset(name for row in self.automaton.table for name in verdicts[row[event]])

    def blocking_refused(self, category: str) -> str | None:
        """``timeout`` comes without a message; a state that only a timeout enters may still be stayed in."""
        super().blocking_refused(category)
        if category == TIMEOUT:
            return "`timeout` happens when no message comes, so there is none to drop"
        return None


def compile_tfsm(source: Source) -> TimedMachine:
    """Compile a ``tfsm`` formula. Raises FormulaError."""
    machine = read_machine(source, timed=True)
    number = {name: index for index, name in enumerate(machine.order)}
    timeouts: list[tuple[int, int] | None] = [
        None if state.timeout is None else (state.timeout[0], number[state.timeout[1].text])
        for state in machine.states.values()
    ]
    timeouts.append(None)
    categories = [*machine.states, *machine.aliases, FAIL, TIMEOUT]
    return TimedMachine(source, categories, machine_automaton(source, machine), tuple(timeouts))


class _ClockRun:
    """A run of a machine with timeout clauses: the deadline is that of the state."""

    __slots__ = ("_table", "_timeouts", "_verdicts", "deadline", "now", "state")
    __copy__ = twin

    def __init__(self, machine: TimedMachine, time_ns: int) -> None:
        self._table = machine.automaton.table
        self._verdicts = machine.automaton.verdicts
        self._timeouts = machine.timeouts
        self.now = time_ns
        self.deadline: int | None = None
        self._enter(machine.automaton.initial)

    def _enter(self, state: int) -> None:
        self.state = state
        timeout = self._timeouts[state]
        self.deadline = None if timeout is None else self.now + timeout[0]

    def step(self, event: int, time_ns: int) -> Categories:
        if time_ns > self.now:
            if self.deadline is not None and time_ns > self.deadline:
                raise ValueError("the deadline has passed: expire the run first")
            self.now = time_ns
        self._enter(self._table[self.state][event])
        return self._verdicts[self.state]

    def expire(self) -> Categories:
        timeout = self._timeouts[self.state]
        if timeout is None or self.deadline is None:
            raise ValueError("this run has no deadline")
        self.now = self.deadline
        self._enter(timeout[1])
        return (TIMEOUT, *self._verdicts[self.state])


class _SilenceRun:
    """A run of a machine without timeout clauses: a second of silence after an event is told once."""

    __slots__ = ("_table", "_verdicts", "deadline", "now", "state")
    __copy__ = twin

    def __init__(self, machine: TimedMachine, time_ns: int) -> None:
        self._table = machine.automaton.table
        self._verdicts = machine.automaton.verdicts
        self.now = time_ns
        self.state = machine.automaton.initial
        self.deadline: int | None = None

    def step(self, event: int, time_ns: int) -> Categories:
        if time_ns > self.now:
            if self.deadline is not None and time_ns > self.deadline:
                raise ValueError("the deadline has passed: expire the run first")
            self.now = time_ns
        self.deadline = self.now + SILENCE_NS
        self.state = self._table[self.state][event]
        return self._verdicts[self.state]

    def expire(self) -> Categories:
        if self.deadline is None:
            raise ValueError("this run has no deadline")
        self.now, self.deadline = self.deadline, None
        return (TIMEOUT,)
