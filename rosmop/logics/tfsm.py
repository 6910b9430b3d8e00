"""``tfsm``: state machines with time bounds.

A state entered by a timeout counts as entered at the deadline, not when the expiry is noticed. A machine without any
timeout clause behaves as in MOP: it reports ``timeout`` once if one second passes after an event without another.
"""

from rosmop.logics.automaton import Automaton
from rosmop.logics.fsm import FAIL, TIMEOUT, machine_automaton, read_state_machine
from rosmop.logics.interface import ClockedProperty, Source, Wait

SILENCE_NS = 10**9


class TimedStateMachine(ClockedProperty):
    """A machine; ``timeouts[state]`` is (nanoseconds, next state) or None.

    With ``silence_ns`` there are no timeout clauses, and the clock runs after each event. Then each state occurs
    twice: after an event, and (in the second half) while the machine waits for no deadline.
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
        size, self.within = len(automaton), 0
        self.initial, self.verdicts = automaton.initial, automaton.verdicts
        self.moves = self.late = tuple(tuple((target, True) for target in row) for row in automaton.table)
        self.waits = tuple(
            None
            if timeout is None
            else Wait(timeout[0], (timeout[1], True), (TIMEOUT, *automaton.verdicts[timeout[1]]))
            for timeout in timeouts
        )
        if self.silence_ns is not None:
            self.initial += size
            self.verdicts, self.moves, self.late = 2 * self.verdicts, 2 * self.moves, 2 * self.late
            silent = [Wait(self.silence_ns, (size + state, True), (TIMEOUT,)) for state in range(size)]
            self.waits = (*silent, *[None] * size)

    def categories_after(self, event: int) -> frozenset[str]:
        verdicts = self.automaton.verdicts
        return frozenset(name for row in self.automaton.table for name in verdicts[row[event]])

    def blocking_refused(self, category: str) -> str | None:
        """Refuse only ``timeout``: an event may come in a state that only a timeout enters, and stay there."""
        super().blocking_refused(category)
        if category == TIMEOUT:
            return "`timeout` happens when no message comes, so there is none to drop"
        return None


def compile_tfsm(source: Source) -> TimedStateMachine:
    machine = read_state_machine(source, timed=True)
    number = {name: index for index, name in enumerate(machine.order)}
    timeouts: list[tuple[int, int] | None] = [
        None if state.timeout is None else (state.timeout[0], number[state.timeout[1].text])
        for state in machine.states.values()
    ]
    timeouts.append(None)
    categories = [*machine.states, *machine.aliases, FAIL, TIMEOUT]
    return TimedStateMachine(source, categories, machine_automaton(source, machine), tuple(timeouts))
