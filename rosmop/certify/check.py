"""Check that an automaton gives, after every trace, the verdict of its formula's definition.

Every reachable pair of a remaining obligation of the definition and a state of the automaton is visited with
every event. There are finitely many, so a result for all pairs holds after every trace. Time bounds,
grammars, and properties that exceed the work limit are not certified.
"""

import itertools
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from typing import TypeVar

from rosmop.certify import formula_reader, patterns
from rosmop.certify.formula_reader import Node, UnsupportedFormulaError, WordReader, WorkLimitError
from rosmop.certify.future import FutureFollower, State, positive
from rosmop.certify.past_formulas import PastFollower
from rosmop.certify.words import ExpressionDerivatives
from roswire.counted import counted

# Follow state machines as written: `state [ event -> state, default state, timeout 2s -> state ]`.

FAIL = "fail"


class StateMachineFollower:
    def __init__(self, formula: str, events: Sequence[str]) -> None:
        self._moves: dict[str, dict[str, str]] = {}
        self._default: dict[str, str] = {}
        self._aliases: dict[str, list[str]] = {}
        self._timeouts: dict[str, tuple[int, str]] = {}
        self._events = events
        words = WordReader(formula, ("->", "[", "]", "=", ","))
        while words.word:
            name = words.take()
            if words.accept("["):
                self._read_state(words, name)
            elif name == "alias":
                name = words.take()
                words.expect("=")
                self._aliases[name] = self._read_members(words)
            else:
                raise UnsupportedFormulaError(f"{name!r} does not begin a state")
        self.initial = next(iter(self._moves), FAIL)

    def _read_state(self, words: WordReader, state: str) -> None:
        if state in self._moves:
            raise UnsupportedFormulaError(f"the state {state!r} is defined twice")
        moves = self._moves.setdefault(state, {})
        while not words.accept("]"):
            event = words.take()
            if event == "timeout" and words.word[:1].isdecimal() | (words.word[:1] == "."):
                after = words.duration()
                words.expect("->")
                self._timeouts[state] = after, words.take()
                words.accept(",")
                continue
            arrow = words.accept("->")
            target = words.take()
            if event == "default":
                self._default[state] = target
            elif arrow and event in self._events:
                moves[event] = target
            else:
                raise UnsupportedFormulaError(f"{event!r} is not an event")
            words.accept(",")

    def _read_members(self, words: WordReader) -> list[str]:
        members = [words.take()]
        while words.accept(",") or (words.word and words.word != "alias"):
            members.append(words.take())
        return members

    def step(self, state: str, event: str) -> str:
        return self._moves.get(state, {}).get(event, self._default.get(state, FAIL))

    def timeout(self, state: str) -> tuple[int, str] | None:
        return self._timeouts.get(state)

    def verdicts(self, state: str) -> tuple[str, ...]:
        return (state, *(alias for alias, members in self._aliases.items() if state in members))


# Replace the operators about the past in a formula about the future.
#
# Their values are guessed with every event: a letter is an event and one bit for each operator. On every
# endless trace, exactly one sequence of guesses satisfies their definitions. So a formula can come true with
# guesses exactly if it could without them.

MAX_LETTERS = 1024

_DEFINED: Mapping[str, tuple[Callable[[Node, Node, Node], Node], bool]] = {
    "once": (lambda x, _y, before: ("or", x, before), False),
    "historically": (lambda x, _y, before: ("and", x, before), True),
    "since": (lambda x, y, before: ("or", y, ("and", x, before)), False),
    "dual since": (lambda x, y, before: ("and", y, ("or", x, before)), True),
}
"""For each operator: its value, from its operands and its previous value, and the value before the first event."""
_BEFORE: Mapping[str, bool] = {"previously": False, "dual previously": True}
"""For each operator: its value at the first event. Later it has the operand's value at the previous event."""


class PastGuesses:
    """The letters of each event, as numbers below `count`, and the formula over sets of them (`one of`)."""

    def __init__(self, formula: Node, events: Sequence[str]) -> None:
        self._guessed: dict[Node, int] = {}
        for node in _within(formula):
            if node[0] in _DEFINED or node[0] in _BEFORE:
                self._guessed.setdefault(node, len(self._guessed))
        count = 1 << len(self._guessed)
        if len(events) * count > MAX_LETTERS:
            raise WorkLimitError
        self.count = len(events) * count
        self.letters = {
            event: range(number * count, (number + 1) * count) for number, event in enumerate(events)
        }
        self.formula = self._over(formula)
        self.rules = [rule for node in self._guessed for rule in self._rules(node)]

    def with_rules(self, formula: Node) -> Node:
        return reduce(lambda left, right: ("and", left, right), self.rules, formula)

    def _over(self, node: Node) -> Node:
        if node in self._guessed:
            bit = 1 << self._guessed[node]
            return ("one of", sum(1 << letter for letter in range(self.count) if letter & bit))
        if node[0] == "event":
            return ("one of", sum(1 << letter for letter in self.letters[str(node[1])]))
        return (node[0], *(self._over(part) if isinstance(part, tuple) else part for part in node[1:]))

    def _rules(self, node: Node) -> list[Node]:
        mine = self._over(node)
        operator = str(node[0])
        operands = [self._over(part) for part in node[1:] if isinstance(part, tuple)]
        if operator in _BEFORE:
            first: Node = mine if _BEFORE[operator] else ("not", mine)
            return [first, ("always", _either(operands[0], ("next", mine), ("next", ("not", mine))))]
        define, at_first = _DEFINED[operator]
        worth = {
            before: ("iff", mine, define(operands[0], operands[-1], ("true",) if before else ("false",)))
            for before in (False, True)
        }
        return [worth[at_first], ("always", _either(mine, ("next", worth[True]), ("next", worth[False])))]


def _either(test: Node, yes: Node, no: Node) -> Node:
    return ("or", ("and", test, yes), ("and", ("not", test), no))


def _within(node: Node) -> list[Node]:
    return [node, *(inner for part in node[1:] if isinstance(part, tuple) for inner in _within(part))]


MAX_STEPS = 200_000
MAX_WORK = 400_000

S = TypeVar("S", bound=Hashable)
Verdicts = tuple[str, ...]


@dataclass(frozen=True)
class AutomatonTables:
    """An automaton to certify. Columns are events in order; `verdicts[s]` hold after a step into `s`."""

    initial: int
    table: Sequence[Sequence[int]]
    verdicts: Sequence[Verdicts]
    timeouts: Sequence[tuple[int, int] | None] = ()
    """For each state of a `tfsm`: the nanoseconds after which the automaton leaves it, and the next state."""


@dataclass(frozen=True)
class Certificate:
    """The result for one property, which was not certified if it is neither `proved` nor `wrong`.

    `text` describes the check, or gives a trace whose verdict differs, or the reason.
    """

    proved: bool
    wrong: bool
    text: str


class _WrongError(Exception):
    pass


def certify(logic: str, formula: str, events: Sequence[str], tables: AutomatonTables | None) -> Certificate:
    check = _CHECKS.get(logic)
    if check is None or tables is None:
        known = "it has no automaton" if tables is None else "the certifier does not know this logic"
        return Certificate(False, False, f"{_NO_AUTOMATON.get(logic, known)}: tested, not proved")
    try:
        _look_at_form(logic, events, tables)
        pairs = check(formula, events, tables)
    except _WrongError as error:
        return Certificate(False, True, str(error))
    except UnsupportedFormulaError as error:
        return Certificate(False, False, f"the certifier does not read it ({error}): tested, not proved")
    except WorkLimitError:
        return Certificate(False, False, "there are too many cases to check: tested, not proved")
    return Certificate(
        True, False, f"proved: its automaton matches its definition ({counted(pairs, 'case')} checked)"
    )


def _look_at_form(logic: str, events: Sequence[str], tables: AutomatonTables) -> None:
    """Reject tables that are not an automaton: Python would count a negative state from the end."""
    limits = [limit for limit in tables.timeouts if limit is not None]
    if len(tables.verdicts) != len(tables.table) or (
        tables.timeouts and len(tables.timeouts) != len(tables.table)
    ):
        raise _WrongError("the number of its verdicts or time limits differs from the number of its states")
    if limits and logic != "tfsm":
        raise _WrongError("it has time limits, but its logic has none")
    for state, row in enumerate(tables.table):
        if len(row) != len(events):
            raise _WrongError(
                f"state {state} has {counted(len(row), 'transition')} for {counted(len(events), 'event')}"
            )
    reached = itertools.chain((tables.initial,), *tables.table, (target for _, target in limits))
    if not all(map(range(len(tables.table)).__contains__, reached)):
        raise _WrongError("a transition leads to a state that does not exist")


_NO_AUTOMATON = {
    "cfg": "grammars are not checked",
    "ptcaret": "it has a stack",
    "srs": "it has no automaton",
    "mtl": "it has time bounds",
    "pattern": "it has a time bound",
}


def _follow(
    start: S,
    step: Callable[[S, str], S],
    verdicts_of: Callable[[S, S, str], Verdicts],
    events: Sequence[str],
    tables: AutomatonTables,
    *,
    silently: Callable[[S, int], S | None] = lambda _before, _state: None,
) -> int:
    """Visit all pairs; `verdicts_of(before, after, event)` returns the verdicts of the definition for a step.

    `silently(before, state)` returns the result of passing time, if time matters.
    """
    first = start, tables.initial
    came: dict[tuple[S, int], tuple[tuple[S, int], str] | None] = {first: None}
    waiting = [first]

    def reach(following: tuple[S, int], pair: tuple[S, int], event: str) -> None:
        if following not in came:
            came[following] = pair, event
            waiting.append(following)
            if len(waiting) * len(events) > MAX_STEPS:
                raise WorkLimitError

    for pair in waiting:
        before, state = pair
        for event, target in zip(events, tables.table[state], strict=True):
            after = step(before, event)
            wanted = verdicts_of(before, after, event)
            if tables.verdicts[target] != wanted:
                trace = [*_trace(came, pair), event]
                raise _WrongError(
                    f"after {' '.join(trace)} the automaton says {_said(tables.verdicts[target])},"
                    f" the definition {_said(wanted)}"
                )
            reach((after, target), pair, event)
        left = silently(before, state)
        if left is not None:
            reach((left, tables.timeouts[state][1]), pair, "(a time limit)")  # type: ignore[index]  # was checked
    return len(waiting)


def _trace(came: dict[tuple[S, int], tuple[tuple[S, int], str] | None], pair: tuple[S, int]) -> Iterable[str]:
    events: list[str] = []
    while (before := came[pair]) is not None:
        pair, event = before
        events.append(event)
    return reversed(events)


def _said(verdicts: Verdicts) -> str:
    return " and ".join(verdicts) or "nothing"


def _check_past(
    grammar: formula_reader.Grammar, formula: str, events: Sequence[str], tables: AutomatonTables
) -> int:
    past = PastFollower(formula_reader.formula(formula, events, grammar))
    steps: dict[tuple[object, str], tuple[tuple[bool, ...], bool]] = {}

    def step(state: tuple[tuple[bool, ...], bool], event: str) -> tuple[tuple[bool, ...], bool]:
        key = state[0], event
        if key not in steps:
            steps[key] = past.step(state[0], event)
        return steps[key]

    return _follow(
        (past.initial, False),
        step,
        lambda _before, after, _event: ("validation",) if after[1] else ("violation",),
        events,
        tables,
    )


def _check_words(formula: str, events: Sequence[str], tables: AutomatonTables) -> int:
    words = ExpressionDerivatives(formula_reader.expression(formula, events), MAX_WORK)
    dead: dict[int, bool] = {}

    def is_dead(state: int) -> bool:
        if state not in dead:
            dead.update(_dead(words, state, events))
        return dead[state]

    def verdicts_of(_before: int, after: int, _event: str) -> Verdicts:
        return ("match",) if words.matches(after) else ("fail",) if is_dead(after) else ()

    return _follow(words.initial, words.step, verdicts_of, events, tables)


def _dead(words: ExpressionDerivatives, start: int, events: Sequence[str]) -> dict[int, bool]:
    leading: dict[int, set[int]] = {start: set()}
    waiting = [start]
    for state in waiting:
        for event in events:
            after = words.step(state, event)
            if after not in leading:
                leading[after] = set()
                waiting.append(after)
                if len(waiting) * len(events) > MAX_STEPS:
                    raise WorkLimitError
            leading[after].add(state)
    alive = {state for state in waiting if words.matches(state)}
    reached = list(alive)
    while reached:
        for before in leading[reached.pop()]:
            if before not in alive:
                alive.add(before)
                reached.append(before)
    return {state: state not in alive for state in waiting}


def _check_future(formula: str, events: Sequence[str], tables: AutomatonTables) -> int:
    return _check_endless(formula_reader.formula(formula, events, formula_reader.LTL), events, events, tables)


def _check_pattern(formula: str, events: Sequence[str], tables: AutomatonTables) -> int:
    return _check_endless(patterns.meaning(formula, events), events, [*events, _SILENCE], tables)


_SILENCE = "(silence)"


def _check_endless(
    formula: formula_reader.Node, events: Sequence[str], letters: Sequence[str], tables: AutomatonTables
) -> int:
    guesses = PastGuesses(formula, letters)
    future = FutureFollower(guesses.count, MAX_WORK)
    sides = (guesses.formula, ("not", guesses.formula))
    start = tuple(future.start(positive(guesses.with_rules(side), guesses.count)) for side in sides)

    def step(state: tuple[State, ...], event: str) -> tuple[State, ...]:
        return tuple(future.steps(side, guesses.letters[event]) for side in state)

    def verdicts_of(_before: object, after: tuple[State, ...], _event: str) -> Verdicts:
        if not future.possible(after[0]):
            return ("violation",)
        return () if future.possible(after[1]) else ("validation",)

    return _follow(start, step, verdicts_of, events, tables)


def _check_machine(formula: str, events: Sequence[str], tables: AutomatonTables) -> int:
    machine = StateMachineFollower(formula, events)

    def silently(before: str, state: int) -> str | None:
        written = machine.timeout(before)
        made = tables.timeouts[state] if tables.timeouts else None
        if (written and written[0]) != (made and made[0]):
            raise _WrongError(f"the time limit of the state {before} is {made and made[0]} ns")
        if written is None or made is None:
            return None
        if tables.verdicts[made[1]] != machine.verdicts(written[1]):
            raise _WrongError(
                f"the time limit of the state {before} leads to {_said(tables.verdicts[made[1]])}"
            )
        return written[1]

    return _follow(
        machine.initial,
        machine.step,
        lambda _before, after, _event: machine.verdicts(after),
        events,
        tables,
        silently=silently,
    )


_CHECKS: dict[str, Callable[[str, Sequence[str], AutomatonTables], int]] = {
    "ere": _check_words,
    "fsm": _check_machine,
    "ltl": _check_future,
    "mtl": partial(_check_past, formula_reader.MTL),
    "pattern": _check_pattern,
    "ptltl": partial(_check_past, formula_reader.PTLTL),
    "tfsm": _check_machine,
}
