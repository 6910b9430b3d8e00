"""Translate the intermediate form of an event (`form/nodes.py`) to terms of z3, as `run/interpreter.py` runs it.

The interpreter also measures the values of a specification once for each megabyte that it allocates; this is left out.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import z3

from rosmop.fast.deferred_output import BYTES, HEAD, OutputLine
from rosmop.form import nodes
from rosmop.prove import expression_terms, message_terms
from rosmop.prove.event_terms import (
    DROPPED,
    MESSAGE,
    REPLACED,
    SAID,
    EventTerms,
    ExpressionRow,
    StatementRow,
    View,
    require_term,
)
from rosmop.prove.loops import GrowingList, constant_for
from rosmop.prove.number_terms import UnknownError, word
from rosmop.prove.terms import (
    AT,
    FRAME,
    LineTerm,
    Mixed,
    NotProvedError,
    State,
    Term,
    TextTerm,
    integer,
    opposite,
)
from rosmop.types import value_types

# Translate statements of the intermediate form to terms of z3, as `run/interpreter.py` runs them.

_LOOPS: Mapping[type[nodes.FormNode], str] = MappingProxyType(
    {
        nodes.ForEach: "it has a loop over an array",
        nodes.Accumulate: "it adds up the elements of an array",
        nodes.Skip: "a field comes after strings or arrays in an array",
    }
)


def evaluate(event: EventTerms, node: nodes.Evaluate, state: State) -> None:
    event.value(node.value, state)


def branch(event: EventTerms, node: nodes.If, state: State) -> None:
    test = event.term(node.test, state)
    yes, no = state.where(test), state.where(opposite(test))
    event.block(node.yes, yes)
    event.block(node.no, no)
    state.join(test, yes, no)


def loop(event: EventTerms, node: nodes.Loop, state: State) -> None:
    def body(state: State) -> tuple[Sequence[State], Sequence[State]]:
        outer = event.breaks, event.continues
        event.breaks, event.continues = [], []
        try:
            event.block(node.body, state)
            return [*event.continues, state], event.breaks
        finally:
            event.breaks, event.continues = outer

    logs: list[GrowingList] = [
        event.event_ends.left,
        event.event_ends.unknown,
        event.event_ends.exits,
        event.noted,
        event.active.returned or [],
    ]
    event.loops.run(state, body, event.active.frame, at_head, logs)


def at_head(_number: int, key: object, value: object) -> Term | Mixed:
    if key in (MESSAGE, SAID):
        raise NotProvedError("not loop-free: a loop changes the message or prints")
    return constant_for(key, value)


def break_loop(event: EventTerms, _node: nodes.Break, state: State) -> None:
    end_at(state, event.breaks)


def continue_loop(event: EventTerms, _node: nodes.Continue, state: State) -> None:
    end_at(state, event.continues)


def end_at(state: State, ends: list[State]) -> None:
    ends.append(state.where(z3.BoolVal(True)))
    state.alive = z3.BoolVal(False)


def left_loop(_event: EventTerms, node: nodes.Statement | nodes.Expression, _state: State) -> None:
    raise NotProvedError(f"not loop-free: {_LOOPS[type(node)]}")


def select(event: EventTerms, node: nodes.Select, state: State) -> None:
    value = event.term(node.value, state)
    number = integer(node.default, 32)
    for wanted, index in reversed(node.table):
        number = z3.If(value == integer(wanted, value.size()), integer(index, 32), number)
    state.slots[event.active.frame, node.name] = number


def return_from(event: EventTerms, node: nodes.Return, state: State) -> None:
    if node.references or event.active.returned is None:
        raise UnknownError("references")
    value = None if node.value.type == value_types.VOID else event.value(node.value, state)
    event.active.returned.append((state.where(z3.BoolVal(True)), value))
    state.alive = z3.BoolVal(False)


def leave(event: EventTerms, node: nodes.Leave, state: State) -> None:
    event.exit(state, bool(node.happened))


def charge(event: EventTerms, node: nodes.Charge, state: State) -> None:
    event.spend(integer(node.instructions, 64), state)


def allocate(event: EventTerms, node: nodes.Allocate, state: State) -> None:
    if node.size is not None:
        event.make(integer(node.size, 64), state)
        return
    size = z3.ZeroExt(32, event.beginning.size)
    many = size > nodes.CHARGED
    yes, no = state.where(many), state.where(opposite(many))
    event.make(size, yes)
    state.join(many, yes, no)


def drop(_event: EventTerms, _node: nodes.Drop, state: State) -> None:
    state.slots[DROPPED] = z3.BoolVal(True)


def stop(event: EventTerms, node: nodes.StopMessage, state: State) -> None:
    safe = next((one for one in node.safes if one.topic == event.topic), None)
    if safe is None:
        raise UnknownError("a safe message that is published")
    other = event.beginning.size != len(safe.data)
    event.ignore(state.where(other), "a safe message of another size than the message")
    state.require(opposite(other))
    event.safe = safe
    state.slots[REPLACED] = z3.BoolVal(True)


def log(event: EventTerms, node: nodes.Log, state: State) -> None:
    line = OutputLine("", node)
    cost, words = integer(line.cost, 64), []
    for expression in line.values:
        value = event.value(expression, state)
        if isinstance(value, TextTerm):
            raise UnknownError("a constant string or array")
        if isinstance(value, View):
            cost = cost + z3.UDiv(value.count, integer(BYTES, 64))
            words.append(text_word(value))
        else:
            words.append(word(require_term(value, expression.type), expression.type))
    put_out(event, node, words, cost, state)


def put_out(event: EventTerms, node: nodes.Log, parts: Sequence[Term], cost: Term, state: State) -> None:
    numbers = [
        integer(number, 32)
        for number, line in enumerate(event.lines)
        if line.node is node and line.context == event.active.function.context
    ]
    event.spend(cost, state)
    begin = state.term(SAID)
    event.noted += (LineTerm(state.alive, begin, numbers), LineTerm(state.alive, begin + 4, [FRAME]))
    offset = HEAD.size
    for part in parts:
        event.noted.append(LineTerm(state.alive, begin + offset, [part]))
        offset += part.size() // 8
    state.slots[SAID] = begin + (offset + 7 & ~7)


def pending(event: EventTerms, node: nodes.Pending, state: State) -> None:
    """Only `Whole` uses the list of fields, and `Whole` is not compiled."""


def require(event: EventTerms, node: nodes.Require, state: State) -> None:
    test = event.term(node.test, state)
    event.exit(state.where(opposite(test)), False)
    state.require(test)


def not_past(event: EventTerms, node: nodes.NotPast, state: State) -> None:
    event.leave_to_python(state, state.term((event.active.frame, node.count)) <= node.index)


def text_word(view: View) -> Term:
    return z3.Concat(z3.Extract(31, 0, view.count), AT + z3.Extract(31, 0, view.start))


STATEMENTS: Mapping[type[nodes.FormNode], StatementRow] = MappingProxyType(
    {
        nodes.Evaluate: evaluate,
        nodes.If: branch,
        nodes.Loop: loop,
        nodes.ForEach: left_loop,
        nodes.Break: break_loop,
        nodes.Continue: continue_loop,
        nodes.Select: select,
        nodes.Return: return_from,
        nodes.Leave: leave,
        nodes.Charge: charge,
        nodes.Allocate: allocate,
        nodes.LimitDepth: nodes.Left("recursion"),
        nodes.Drop: drop,
        nodes.Reset: nodes.Left("a reset"),
        nodes.StopMessage: stop,
        nodes.Publish: nodes.Left("a message to publish"),
        nodes.AfterText: message_terms.after_text,
        nodes.Count: message_terms.count_elements,
        nodes.AfterElements: message_terms.after_elements,
        nodes.Skip: left_loop,
        nodes.NotPast: not_past,
        nodes.Ends: message_terms.ends_at,
        nodes.ReadNumbers: message_terms.read_numbers,
        nodes.ReadValue: message_terms.read_value,
        nodes.Require: require,
        nodes.Pending: pending,
        nodes.WriteBack: message_terms.write_back,
    }
)
EXPRESSIONS: Mapping[type[nodes.FormNode], ExpressionRow] = MappingProxyType(
    {
        nodes.Literal: expression_terms.literal,
        nodes.Read: expression_terms.read,
        nodes.Assign: expression_terms.assign,
        nodes.Convert: expression_terms.convert,
        nodes.Arithmetic: expression_terms.arithmetic,
        nodes.Unary: expression_terms.unary,
        nodes.Moment: expression_terms.moment,
        nodes.MomentOf: expression_terms.moment_of,
        nodes.Compare: expression_terms.compare,
        nodes.CompareTexts: expression_terms.compare_texts,
        nodes.Logical: expression_terms.logical,
        nodes.Not: expression_terms.negation,
        nodes.Conditional: expression_terms.conditional,
        nodes.Sequence: expression_terms.sequence,
        nodes.Discard: expression_terms.discard,
        nodes.Item: expression_terms.item,
        nodes.Vector: nodes.Left("an array that is built"),
        nodes.Zero: expression_terms.zero,
        nodes.Copy: expression_terms.copied,
        nodes.Recast: nodes.Left("a converted array of bytes"),
        nodes.OfType: nodes.Left("a function for values of any type"),
        nodes.Call: expression_terms.call,
        nodes.Accumulate: left_loop,
        nodes.Invoke: expression_terms.invoke,
        nodes.Format: nodes.Left("formatted text"),
        nodes.Join: nodes.Left("joined strings"),
        nodes.Log: log,
        nodes.Throttle: expression_terms.throttle,
        nodes.Now: expression_terms.now,
        nodes.SenderName: expression_terms.sender,
        nodes.Altered: expression_terms.altered,
        nodes.Whole: nodes.Left("MESSAGE"),
    }
)


class FormTerms(EventTerms):
    """Translates one event on a topic."""

    statements = STATEMENTS
    expressions = EXPRESSIONS
