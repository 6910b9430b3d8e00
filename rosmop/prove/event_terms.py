"""The translation of one event to terms of z3: its state, its ends and its budget.

`form_terms.py` has the rows of statements and expressions. A row is a function of the event, a node and the state.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import z3

from rosmop.fast.deferred_output import OutputLine
from rosmop.form import nodes
from rosmop.prove.loops import BUDGET_SLOT, Loops
from rosmop.prove.number_terms import UnknownError
from rosmop.prove.terms import (
    LineTerm,
    Mixed,
    StartTerms,
    State,
    Term,
    TextTerm,
    both,
    choice,
    either,
    integer,
    merge,
    opposite,
)
from rosmop.runtime.action_context import BYTES_PER_INSTRUCTION, UNMEASURED
from rosmop.runtime.values import ValueCodec
from rosmop.types.value_types import Type

MESSAGE, DROPPED, REPLACED, CHANGED, SAID = "message", "dropped", "replaced", "changed", "said"


@dataclass(frozen=True)
class View:
    message: Term
    start: Term
    count: Term


Value = Term | TextTerm | View | Mixed | None
"""The value of an expression; that of a procedure's call is None."""


@dataclass(frozen=True)
class FormResult:
    """The result of an event, valid unless `left` (the condition of a fault) or one of `unknown` (by reason) holds.

    The lines of output are `noted`, and take `said` bytes.
    """

    left: Term
    unknown: Mapping[str, Term]
    happened: Term
    dropped: Term
    replaced: Term
    changed: Term
    message: Term
    variables: Mapping[str, object]
    budgets: Mapping[str, Term]
    said: Term
    noted: Sequence[LineTerm]
    loops: Loops


@dataclass(frozen=True)
class EventEnds:
    """How the event ends: `left` to Python, with something `unknown` (by reason), or at `exits` (did it happen?)."""

    left: list[Term] = field(default_factory=list)
    unknown: list[tuple[str, Term]] = field(default_factory=list)
    exits: list[tuple[State, Term]] = field(default_factory=list)


@dataclass(frozen=True)
class ActiveCall:
    """A call that is being translated; `frame` is its number. `returned` is None for the event, which has no caller."""

    frame: int
    function: nodes.Function
    returned: list[tuple[State, Value]] | None


StatementRow = Callable[["EventTerms", Any, State], None] | nodes.Left
ExpressionRow = Callable[["EventTerms", Any, State], Value] | nodes.Left


class EventTerms:
    """Translates one event on a topic. `lines` are the module's lines of output. Raises `NotProvedError`."""

    statements: ClassVar[Mapping[type[nodes.FormNode], StatementRow]]
    expressions: ClassVar[Mapping[type[nodes.FormNode], ExpressionRow]]

    def __init__(
        self,
        functions: Mapping[str, nodes.Function],
        values: ValueCodec,
        beginning: StartTerms,
        name: str,
        *,
        topic: str,
        lines: Sequence[OutputLine] = (),
        unrolled: int = 0,
    ) -> None:
        self.lines = lines
        self.noted: list[LineTerm] = []
        self.functions = functions
        self.values = values
        self.beginning = beginning
        self.topic = topic
        self.safe: nodes.SafeMessage | None = None
        self.function = functions[name]
        self.loops = Loops(unrolled)
        self.breaks: list[State] = []
        self.continues: list[State] = []
        self.event_ends = EventEnds()
        self.calls = 0
        self.active = ActiveCall(0, self.function, None)

    def result(self) -> FormResult:
        begin, no = self.beginning, z3.BoolVal(False)
        budget = begin.budgets[self.function.context]
        slots: dict[object, object] = {MESSAGE: begin.message, DROPPED: no, REPLACED: no, CHANGED: no}
        slots |= {BUDGET_SLOT: budget, SAID: integer(0, 32)}
        slots |= {("shared", name): value for name, value in begin.variables.items()}
        state = State(z3.BoolVal(True), slots)
        self.block(self.function.body, state)
        self.event_ends.left.append(state.alive)  # every message leaves the function before its end
        happened: Term = no
        end = State(no, slots)
        for left, value in self.event_ends.exits:
            happened = choice(left.alive, value, happened)
            end = State(no, merge(left.alive, left, State(opposite(left.alive), end.slots)))
        unknown: dict[str, Term] = {}
        for what, condition in self.event_ends.unknown:
            unknown[what] = either(unknown.get(what, no), condition)
        variables = {name: end.slots["shared", name] for name in begin.variables}
        budgets = {**begin.budgets, self.function.context: end.term(BUDGET_SLOT)}
        return FormResult(
            either(*self.event_ends.left), unknown, happened, end.term(DROPPED), end.term(REPLACED),
            end.term(CHANGED), end.term(MESSAGE), variables, budgets, end.term(SAID), self.noted, self.loops,
        )  # fmt: skip

    def leave_to_python(self, state: State, condition: Term) -> None:
        self.event_ends.left.append(both(state.alive, condition))
        state.require(opposite(condition))

    def ignore(self, state: State, what: str) -> None:
        self.event_ends.unknown.append((what, state.alive))
        state.alive = z3.BoolVal(False)

    def exit(self, state: State, happened: bool) -> None:
        self.event_ends.exits.append((state.where(z3.BoolVal(True)), z3.BoolVal(happened)))
        state.alive = z3.BoolVal(False)

    def block(self, statements: Sequence[nodes.Statement], state: State) -> None:
        for statement in statements:
            if z3.is_false(state.alive):
                return
            row = self.statements[type(statement)]
            try:
                if isinstance(row, nodes.Left):
                    raise UnknownError(row.reason)
                row(self, statement, state)
            except UnknownError as error:
                self.ignore(state, str(error))

    def value(self, node: nodes.Expression, state: State) -> Value:
        row = self.expressions[type(node)]
        if isinstance(row, nodes.Left):
            raise UnknownError(row.reason)
        return row(self, node, state)

    def term(self, node: nodes.Expression, state: State) -> Term:
        return require_term(self.value(node, state), node.type)

    def spend(self, instructions: Term, state: State) -> None:
        rest = state.term(BUDGET_SLOT) - instructions
        state.slots[BUDGET_SLOT] = rest
        self.leave_to_python(state, rest < 0)

    def make(self, size: Term, state: State) -> None:
        self.leave_to_python(state, z3.UGT(size, UNMEASURED))
        self.spend(z3.UDiv(size, integer(BYTES_PER_INSTRUCTION, 64)), state)


def require_term(value: Value, kind: Type) -> Term:
    if not isinstance(value, Term):
        raise UnknownError(f"a value of type {kind}")
    return value
