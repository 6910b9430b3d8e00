"""Translate the intermediate form of an event (`form/nodes.py`) to terms of z3, as `run/interpreter.py` runs it.

- Positions and counts have 64 bits here, but are unbounded in the interpreter. A function without loops adds a few
products of a count below 2**32 and a size, which never exceed 64 bits; nor does the sum of two times.
- For 32-bit floats, the interpreter rounds the double result of `+ - * /`. That equals the result on floats, because
a double has more than twice as many digits.
- The interpreter also measures the values of a specification once for each megabyte that it allocates; this is left
out.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from types import MappingProxyType
from typing import Any

import z3

from rosmop.fast.abi import kept_size, most_kept
from rosmop.fast.deferred_output import BYTES, HEAD, OutputLine
from rosmop.form import nodes
from rosmop.prove.loops import BUDGET_SLOT, GrowingList, Loops, constant_for
from rosmop.prove.terms import (
    AT,
    DOUBLE,
    FRAME,
    MEMORY,
    MISMATCH,
    MIXED,
    NEAREST,
    SECONDS,
    SINGLE,
    LineTerm,
    Mixed,
    NotProvedError,
    StartTerms,
    State,
    Term,
    TextTerm,
    as_bits,
    both,
    choice,
    either,
    floating,
    integer,
    merged,
    number_at,
    opposite,
    with_number,
    with_sign,
)
from rosmop.runtime import times
from rosmop.runtime.action_context import BYTES_PER_INSTRUCTION, UNMEASURED
from rosmop.runtime.safe_messages import HEAD as SAFE_HEAD
from rosmop.runtime.values import ValueCodec, struct_code, struct_size
from rosmop.runtime.wire import MAX_EMPTY
from rosmop.types import value_types
from rosmop.types.value_types import Type

_MESSAGE, _DROPPED, _REPLACED, _CHANGED, _SAID = "message", "dropped", "replaced", "changed", "said"


@dataclass(frozen=True)
class _View:
    message: Term
    start: Term
    count: Term


Value = Term | TextTerm | _View | Mixed | None
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


_LONG = value_types.IntegerType(64, True, "long")

_LOOPS: Mapping[type[nodes.FormNode], str] = MappingProxyType(
    {
        nodes.ForEach: "it has a loop over an array",
        nodes.Accumulate: "it adds up the elements of an array",
        nodes.Skip: "a field comes after strings or arrays in an array",
    }
)


class UnknownError(Exception):
    """The form has a node that cannot be translated."""


def is_signed(kind: Type) -> bool:
    return not isinstance(kind, value_types.IntegerType) or kind.signed


def width(kind: Type) -> int:
    return 32 if isinstance(kind, value_types.IntegerType) and kind.bits <= 32 else 64


def wrapped(value: Term, kind: value_types.IntegerType) -> Term:
    if kind.bits >= 32:
        return value
    return (z3.SignExt if kind.signed else z3.ZeroExt)(32 - kind.bits, z3.Extract(kind.bits - 1, 0, value))


def _text(view: _View) -> Term:
    return z3.Concat(z3.Extract(31, 0, view.count), AT + z3.Extract(31, 0, view.start))


def _word(value: Term, kind: Type) -> Term:
    if isinstance(kind, value_types.FloatingType):
        return z3.fpToIEEEBV(value if kind.bits == 64 else z3.fpFPToFP(NEAREST, value, DOUBLE))
    bits = as_bits(value) if z3.is_bool(value) else value
    return bits if bits.size() == 64 else (z3.SignExt if is_signed(kind) else z3.ZeroExt)(32, bits)


@dataclass(frozen=True)
class _EventEnds:
    """How the event ends: `left` to Python, with something `unknown` (by reason), or at `exits` (did it happen?)."""

    left: list[Term] = field(default_factory=list)
    unknown: list[tuple[str, Term]] = field(default_factory=list)
    exits: list[tuple[State, Term]] = field(default_factory=list)


@dataclass(frozen=True)
class _ActiveCall:
    """A call that is being translated; `frame` is its number. `returned` is None for the event, which has no caller."""

    frame: int
    function: nodes.Function
    returned: list[tuple[State, Value]] | None


class FormTerms:
    """Translates one event on a topic. `lines` are the module's lines of output. Raises `NotProvedError`."""

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
        self._lines = lines
        self._noted: list[LineTerm] = []
        self._functions = functions
        self._values = values
        self._beginning = beginning
        self._topic = topic
        self._safe: nodes.SafeMessage | None = None
        self._function = functions[name]
        self._loops = Loops(unrolled)
        self._breaks: list[State] = []
        self._continues: list[State] = []
        self._event_ends = _EventEnds()
        self._calls = 0
        self._active = _ActiveCall(0, self._function, None)

    def result(self) -> FormResult:
        begin, no = self._beginning, z3.BoolVal(False)
        budget = begin.budgets[self._function.context]
        slots: dict[object, object] = {_MESSAGE: begin.message, _DROPPED: no, _REPLACED: no, _CHANGED: no}
        slots |= {BUDGET_SLOT: budget, _SAID: integer(0, 32)}
        slots |= {("shared", name): value for name, value in begin.variables.items()}
        state = State(z3.BoolVal(True), slots)
        self._block(self._function.body, state)
        self._event_ends.left.append(state.alive)  # every message leaves the function before its end
        happened: Term = no
        end = State(no, slots)
        for left, value in self._event_ends.exits:
            happened = choice(left.alive, value, happened)
            end = State(no, merged(left.alive, left, State(opposite(left.alive), end.slots)))
        unknown: dict[str, Term] = {}
        for what, condition in self._event_ends.unknown:
            unknown[what] = either(unknown.get(what, no), condition)
        variables = {name: end.slots["shared", name] for name in begin.variables}
        budgets = {**begin.budgets, self._function.context: end.term(BUDGET_SLOT)}
        return FormResult(
            either(*self._event_ends.left), unknown, happened, end.term(_DROPPED), end.term(_REPLACED),
            end.term(_CHANGED), end.term(_MESSAGE), variables, budgets, end.term(_SAID), self._noted, self._loops,
        )  # fmt: skip

    # Ends

    def _leave_to_python(self, state: State, condition: Term) -> None:
        self._event_ends.left.append(both(state.alive, condition))
        state.require(opposite(condition))

    def _ignore(self, state: State, what: str) -> None:
        self._event_ends.unknown.append((what, state.alive))
        state.alive = z3.BoolVal(False)

    def _exit(self, state: State, happened: bool) -> None:
        self._event_ends.exits.append((state.where(z3.BoolVal(True)), z3.BoolVal(happened)))
        state.alive = z3.BoolVal(False)

    # Statements

    def _block(self, statements: Sequence[nodes.Statement], state: State) -> None:
        for statement in statements:
            if z3.is_false(state.alive):
                return
            row = STATEMENTS[type(statement)]
            try:
                if isinstance(row, nodes.Left):
                    raise UnknownError(row.reason)
                row(self, statement, state)
            except UnknownError as error:
                self._ignore(state, str(error))

    def _evaluate(self, node: nodes.Evaluate, state: State) -> None:
        self._value(node.value, state)

    def _if(self, node: nodes.If, state: State) -> None:
        test = self._term(node.test, state)
        yes, no = state.where(test), state.where(opposite(test))
        self._block(node.yes, yes)
        self._block(node.no, no)
        state.join(test, yes, no)

    def _loop(self, node: nodes.Loop, state: State) -> None:
        def body(state: State) -> tuple[Sequence[State], Sequence[State]]:
            outer = self._breaks, self._continues
            self._breaks, self._continues = [], []
            try:
                self._block(node.body, state)
                return [*self._continues, state], self._breaks
            finally:
                self._breaks, self._continues = outer

        logs: list[GrowingList] = [
            self._event_ends.left,
            self._event_ends.unknown,
            self._event_ends.exits,
            self._noted,
            self._active.returned or [],
        ]
        self._loops.run(state, body, self._active.frame, self._at_head, logs)

    def _at_head(self, _number: int, key: object, value: object) -> Term | Mixed:
        if key in (_MESSAGE, _SAID):
            raise NotProvedError("not loop-free: a loop changes the message or prints")
        return constant_for(key, value)

    def _break(self, _node: nodes.Break, state: State) -> None:
        self._end(state, self._breaks)

    def _continue(self, _node: nodes.Continue, state: State) -> None:
        self._end(state, self._continues)

    def _end(self, state: State, ends: list[State]) -> None:
        ends.append(state.where(z3.BoolVal(True)))
        state.alive = z3.BoolVal(False)

    def _repeat(self, node: nodes.Statement | nodes.Expression, _state: State) -> None:
        raise NotProvedError(f"not loop-free: {_LOOPS[type(node)]}")

    def _select(self, node: nodes.Select, state: State) -> None:
        value = self._term(node.value, state)
        number = integer(node.default, 32)
        for wanted, index in reversed(node.table):
            number = z3.If(value == integer(wanted, value.size()), integer(index, 32), number)
        state.slots[self._active.frame, node.name] = number

    def _return(self, node: nodes.Return, state: State) -> None:
        if node.references or self._active.returned is None:
            raise UnknownError("references")
        value = None if node.value.type == value_types.VOID else self._value(node.value, state)
        self._active.returned.append((state.where(z3.BoolVal(True)), value))
        state.alive = z3.BoolVal(False)

    def _leave(self, node: nodes.Leave, state: State) -> None:
        self._exit(state, bool(node.happened))

    def _charge(self, node: nodes.Charge, state: State) -> None:
        self._spend(integer(node.instructions, 64), state)

    def _spend(self, instructions: Term, state: State) -> None:
        rest = state.term(BUDGET_SLOT) - instructions
        state.slots[BUDGET_SLOT] = rest
        self._leave_to_python(state, rest < 0)

    def _allocate(self, node: nodes.Allocate, state: State) -> None:
        if node.size is not None:
            self._make(integer(node.size, 64), state)
            return
        size = z3.ZeroExt(32, self._beginning.size)
        many = size > nodes.CHARGED
        yes, no = state.where(many), state.where(opposite(many))
        self._make(size, yes)
        state.join(many, yes, no)

    def _make(self, size: Term, state: State) -> None:
        self._leave_to_python(state, z3.UGT(size, UNMEASURED))
        self._spend(z3.UDiv(size, integer(BYTES_PER_INSTRUCTION, 64)), state)

    def _drop(self, _node: nodes.Drop, state: State) -> None:
        state.slots[_DROPPED] = z3.BoolVal(True)

    def _stop(self, node: nodes.StopMessage, state: State) -> None:
        safe = next((one for one in node.safes if one.topic == self._topic), None)
        if safe is None:
            raise UnknownError("a safe message that is published")
        other = self._beginning.size != len(safe.data)
        self._ignore(state.where(other), "a safe message of another size than the message")
        state.require(opposite(other))
        self._safe = safe
        state.slots[_REPLACED] = z3.BoolVal(True)

    def _put_safe(self, safe: nodes.SafeMessage, state: State) -> None:
        message, changed = state.term(_MESSAGE), state.term(_CHANGED)
        place = SAFE_HEAD if safe.stamped else 0
        while place < len(
            safe.data
        ):  # the largest numbers that fit, as in the module, so that terms are alike
            size = next(size for size in (8, 4, 2, 1) if place + size <= len(safe.data))
            new = integer(int.from_bytes(safe.data[place : place + size], "little"), 8 * size)
            differs = opposite(number_at(message, integer(place, 32), size) == new)
            message = choice(differs, with_number(message, integer(place, 32), new), message)
            changed = either(changed, differs)
            place += size
        state.slots |= {_MESSAGE: message, _CHANGED: changed}

    def _log(self, node: nodes.Log, state: State) -> None:
        line = OutputLine("", node)
        cost, words = integer(line.cost, 64), []
        for expression in line.values:
            value = self._value(expression, state)
            if isinstance(value, TextTerm):
                raise UnknownError("a constant string or array")
            if isinstance(value, _View):
                cost = cost + z3.UDiv(value.count, integer(BYTES, 64))
                words.append(_text(value))
            else:
                words.append(_word(_known(value, expression.type), expression.type))
        self._put_out(node, words, cost, state)

    def _put_out(self, node: nodes.Log, parts: Sequence[Term], cost: Term, state: State) -> None:
        numbers = [
            integer(number, 32)
            for number, line in enumerate(self._lines)
            if line.node is node and line.context == self._active.function.context
        ]
        self._spend(cost, state)
        begin = state.term(_SAID)
        self._noted += (LineTerm(state.alive, begin, numbers), LineTerm(state.alive, begin + 4, [FRAME]))
        offset = HEAD.size
        for part in parts:
            self._noted.append(LineTerm(state.alive, begin + offset, [part]))
            offset += part.size() // 8
        state.slots[_SAID] = begin + (offset + 7 & ~7)

    def _pending(self, node: nodes.Pending, state: State) -> None:
        """Only `Whole` uses the list of fields, and `Whole` is not compiled."""

    def _require(self, node: nodes.Require, state: State) -> None:
        test = self._term(node.test, state)
        self._exit(state.where(opposite(test)), False)
        state.require(test)

    def _not_past(self, node: nodes.NotPast, state: State) -> None:
        self._leave_to_python(state, state.term((self._active.frame, node.count)) <= node.index)

    # Fields of the message

    def _position(self, at: nodes.Spot, state: State) -> Term:
        offset = integer(at.offset, 64)
        return offset if at.base is None else state.term((self._active.frame, at.base)) + offset

    def _place(self, at: nodes.Spot, state: State) -> Term:
        offset = integer(at.offset, 32)
        return (
            offset
            if at.base is None
            else z3.Extract(31, 0, state.term((self._active.frame, at.base))) + offset
        )

    def _within(self, at: nodes.Spot, size: int, state: State) -> None:
        short = z3.ULT(z3.ZeroExt(32, self._beginning.size), self._position(at.plus(size), state))
        self._leave_to_python(state, short)

    def _length(self, at: nodes.Spot, state: State) -> Term:
        self._within(at, 4, state)
        return z3.ZeroExt(32, number_at(state.term(_MESSAGE), self._place(at, state), 4))

    def _after_text(self, node: nodes.AfterText, state: State) -> None:
        length = self._length(node.at, state)
        state.slots[self._active.frame, node.name] = self._position(node.at.plus(4), state) + length

    def _count(self, node: nodes.Count, state: State) -> None:
        state.slots[self._active.frame, node.name] = self._counted(node.at, node.least, state)

    def _counted(self, at: nodes.Spot, least: int, state: State) -> Term:
        count = self._length(at, state)
        room = z3.ZeroExt(32, self._beginning.size) - self._position(at.plus(4), state)
        many = z3.UGT(count * least, room) if least else z3.UGT(count, MAX_EMPTY)
        self._leave_to_python(state, many)
        return count

    def _after_elements(self, node: nodes.AfterElements, state: State) -> None:
        count = (
            integer(node.count, 64)
            if isinstance(node.count, int)
            else state.term((self._active.frame, node.count))
        )
        state.slots[self._active.frame, node.name] = self._position(node.at, state) + count * node.size

    def _ends(self, node: nodes.Ends, state: State) -> None:
        end = self._position(node.at, state)
        self._leave_to_python(state, end != z3.ZeroExt(32, self._beginning.size))

    def _read_numbers(self, node: nodes.ReadNumbers, state: State) -> None:
        self._within(node.at, max(offset + self._size(kind) for _, kind, offset in node.fields), state)
        for name, kind, offset in node.fields:
            place = self._place(node.at.plus(offset), state)
            state.slots[self._active.frame, name] = self._number(state.term(_MESSAGE), place, kind)

    def _number(self, message: Term, place: Term, kind: Type) -> Term:
        return self._decoded(number_at(message, place, self._size(kind)), kind)

    def _decoded(self, bits: Term, kind: Type) -> Term:
        if isinstance(kind, value_types.TimeType | value_types.DurationType):
            extend = z3.ZeroExt if kind == value_types.TIME else z3.SignExt
            seconds, rest = (extend(32, z3.Extract(more + 31, more, bits)) for more in (0, 32))
            return seconds * integer(times.BILLION, 64) + rest
        if isinstance(kind, value_types.BoolType):
            return bits != 0
        if isinstance(kind, value_types.FloatingType):
            return z3.fpBVToFP(bits, DOUBLE if kind.bits == 64 else SINGLE)
        if not isinstance(kind, value_types.IntegerType):
            raise UnknownError(f"a value of type {kind}")
        missing = width(kind) - bits.size()
        return bits if not missing else (z3.SignExt if kind.signed else z3.ZeroExt)(missing, bits)

    def _size(self, kind: Type) -> int:
        code = struct_code(kind)
        if code is not None:
            return struct_size(code)
        if isinstance(kind, value_types.RecordType):
            return sum(map(self._size, self._values.fields(kind)))
        if isinstance(kind, value_types.VectorType) and kind.length is not None:
            return kind.length * self._size(kind.element)
        raise UnknownError(f"a value of type {kind} in a vector or message")

    def _read_value(self, node: nodes.ReadValue, state: State) -> None:
        kind, start = node.type, self._position(node.at, state)
        count, size = integer(1, 64), 1
        if isinstance(kind, value_types.StringType):
            count = self._length(node.at, state)
            start = self._position(node.at.plus(4), state)
            self._leave_to_python(state, z3.UGT(start + count, z3.ZeroExt(32, self._beginning.size)))
        elif isinstance(kind, value_types.VectorType) and kind.length is None:
            size = self._size(kind.element)
            count = self._counted(node.at, size, state)
            start = self._position(node.at.plus(4), state)
        else:
            size = self._size(kind)
            self._within(node.at, size, state)
            if isinstance(kind, value_types.VectorType):
                count, size = integer(kind.length or 0, 64), self._size(kind.element)
        state.slots[self._active.frame, node.name] = _View(state.term(_MESSAGE), start, count)
        state.slots[self._active.frame, node.end] = start + count * size

    def _write_back(self, node: nodes.WriteBack, state: State) -> None:
        dropped = state.term(_DROPPED)
        self._exit(state.where(dropped), True)
        state.require(opposite(dropped))
        if self._safe is not None:
            replaced = state.term(_REPLACED)
            stopped = state.where(replaced)
            self._put_safe(self._safe, stopped)
            self._exit(stopped, True)
            state.require(opposite(replaced))
        puts = []
        for write in node.writes:
            flag = state.term((self._active.frame, write.flag))
            if write.end is not None:
                self._ignore(state.where(flag), "a string or vector that is written")
                state.require(opposite(flag))
                continue
            wanted = state.where(flag)
            bits = self._packed(self._term(write.value, wanted), write.value.type, wanted)
            state.alive = either(wanted.alive, state.where(opposite(flag)).alive)
            puts.append((flag, bits, self._place(write.at, state)))
        for flag, bits, place in puts:
            message = state.term(_MESSAGE)
            differs = both(flag, number_at(message, place, bits.size() // 8) != bits)
            state.slots[_MESSAGE] = choice(differs, with_number(message, place, bits), message)
            state.slots[_CHANGED] = either(state.term(_CHANGED), differs)

    def _packed(self, value: Term, kind: Type, state: State) -> Term:
        if isinstance(kind, value_types.FloatingType):
            self._leave_to_python(state, z3.fpIsNaN(value))
            return z3.fpToIEEEBV(value)
        if isinstance(kind, value_types.BoolType):
            return as_bits(value, 8)
        if isinstance(kind, value_types.IntegerType):
            return z3.Extract(kind.bits - 1, 0, value)
        seconds, rest = self._parts(value)
        least, most = (0, 1 << 32) if kind == value_types.TIME else (-(1 << 31), 1 << 31)
        self._leave_to_python(state, either(seconds < least, seconds >= most))
        return z3.Concat(z3.Extract(31, 0, rest), z3.Extract(31, 0, seconds))

    def _parts(self, value: Term) -> tuple[Term, Term]:
        billion = integer(times.BILLION, 64)
        rest = z3.SRem(value, billion)
        rest = z3.If(rest < 0, rest + billion, rest)
        return (value - rest) / billion, rest

    # Expressions

    def _value(self, node: nodes.Expression, state: State) -> Value:
        row = EXPRESSIONS[type(node)]
        if isinstance(row, nodes.Left):
            raise UnknownError(row.reason)
        return row(self, node, state)

    def _term(self, node: nodes.Expression, state: State) -> Term:
        return _known(self._value(node, state), node.type)

    def _literal(self, node: nodes.Literal, _state: State) -> Value:
        if node.value is None:
            return None
        if isinstance(node.value, bytes) and kept_size(node.type):
            return self._constant(node.value, kept_size(node.type))
        if isinstance(node.value, bytes | str):
            raise UnknownError("a constant string or array")
        if isinstance(node.type, value_types.FloatingType):
            return floating(node.value, node.type.bits)
        return self._whole_number(int(node.value), node.type)

    def _constant(self, raw: bytes, size: int = 1) -> TextTerm:
        if raw not in self._beginning.constants:
            raise UnknownError("a constant string or array")
        return TextTerm(integer(self._beginning.constants[raw], 32), integer(len(raw) // size, 64))

    def _whole_number(self, value: int, kind: Type) -> Term:
        return (
            z3.BoolVal(bool(value)) if isinstance(kind, value_types.BoolType) else integer(value, width(kind))
        )

    def _zero(self, node: nodes.Zero, state: State) -> Value:
        if isinstance(node.type, value_types.FloatingType):
            return self._literal(nodes.Literal(node.type, 0.0), state)
        if isinstance(node.type, value_types.StringType):
            return self._constant(b"")
        if size := kept_size(node.type):
            assert isinstance(node.type, value_types.VectorType)  # noqa: S101  strings are above
            return self._constant(bytes(size * (node.type.length or 0)), size)
        if not isinstance(
            node.type,
            value_types.BoolType | value_types.IntegerType | value_types.TimeType | value_types.DurationType,
        ):
            raise UnknownError(f"a zero of type {node.type}")
        return self._whole_number(0, node.type)

    def _read(self, node: nodes.Read, state: State) -> Value:
        own, shared = (self._active.frame, node.name), ("shared", node.name)
        value = state.slots.get(own if own in state.slots else shared)
        if not isinstance(value, Term | TextTerm | _View):
            raise UnknownError(f"a variable of type {node.type}")
        return value if own in state.slots else self._kept(value, node.type, state)

    def _kept(self, value: Value, kind: Type, state: State) -> Value:
        if isinstance(value, _View) and kept_size(kind):
            value = TextTerm(AT + z3.Extract(31, 0, value.start), value.count)
        if isinstance(value, TextTerm):
            self._leave_to_python(state, z3.UGT(value.count, most_kept(kind)))
        return value

    def _assign(self, node: nodes.Assign, state: State) -> Value:
        value = self._value(node.value, state)
        where: int | str = "shared" if node.name in self._active.function.shared else self._active.frame
        if where == "shared" and node.name not in self._beginning.variables:
            raise UnknownError(f"a variable of type {node.type}")
        state.slots[where, node.name] = self._kept(value, node.type, state) if where == "shared" else value
        return value

    def _convert(self, node: nodes.Convert, state: State) -> Value:
        return self._converted(self._term(node.value, state), node.value.type, node.type)

    def _converted(self, value: Term, source: Type, target: Type) -> Term:
        if isinstance(target, value_types.BoolType):
            if isinstance(source, value_types.FloatingType):
                return opposite(z3.fpIsZero(value))
            return value if isinstance(source, value_types.BoolType) else value != 0
        if isinstance(source, value_types.BoolType):
            source, value = value_types.INT, as_bits(value)
        if isinstance(target, value_types.FloatingType):
            sort = DOUBLE if target.bits == 64 else SINGLE
            if isinstance(source, value_types.FloatingType):
                return value if source.bits == target.bits else z3.fpFPToFP(NEAREST, value, sort)
            return (z3.fpSignedToFP if is_signed(source) else z3.fpUnsignedToFP)(NEAREST, value, sort)
        if not isinstance(target, value_types.IntegerType):
            raise UnknownError(f"a conversion to {target}")
        if isinstance(source, value_types.FloatingType):
            return self._truncated(self._converted(value, source, value_types.FloatingType(64)), target)
        if width(target) > value.size():
            value = (z3.SignExt if is_signed(source) else z3.ZeroExt)(32, value)
        return wrapped(value if width(target) == value.size() else z3.Extract(31, 0, value), target)

    def _truncated(self, value: Term, target: value_types.IntegerType) -> Term:
        whole = target if target.bits >= 32 else value_types.INT
        bits = whole.bits
        least, most = floating(whole.least, 64), floating(whole.most, 64)
        cut = (z3.fpToSBV if whole.signed else z3.fpToUBV)(z3.RTZ(), value, z3.BitVecSort(bits))
        high = z3.If(z3.fpGEQ(value, most), integer(whole.most, bits), cut)
        low = z3.If(z3.fpLEQ(value, least), integer(whole.least, bits), high)
        result = z3.If(z3.fpIsNaN(value), integer(0, bits), low)
        if whole is not target:
            result = z3.If(result < target.least, integer(target.least, 32), result)
            result = z3.If(result > target.most, integer(target.most, 32), result)
        return result

    def _arithmetic(self, node: nodes.Arithmetic, state: State) -> Value:
        left, right = self._term(node.left, state), self._term(node.right, state)
        kind, operator = node.type, node.operator
        if isinstance(kind, value_types.FloatingType):
            return _OF_FLOATS[operator](NEAREST, left, right)
        assert isinstance(kind, value_types.IntegerType)  # noqa: S101  operands have one of two types
        if operator in "/%":
            self._leave_to_python(state, right == 0)
            if operator == "/":
                result = left / right if kind.signed else z3.UDiv(left, right)
            else:
                result = z3.SRem(left, right) if kind.signed else z3.URem(left, right)
        elif operator in ("<<", ">>"):
            missing = left.size() - right.size()
            amount = z3.ZeroExt(32, right) if missing > 0 else z3.Extract(31, 0, right) if missing else right
            amount = amount & (kind.bits - 1)
            result = (
                left << amount
                if operator == "<<"
                else left >> amount
                if kind.signed
                else z3.LShR(left, amount)
            )
        else:
            result = _OF_INTEGERS[operator](left, right)
        return wrapped(result, kind)

    def _unary(self, node: nodes.Unary, state: State) -> Value:
        value = self._term(node.value, state)
        if isinstance(node.type, value_types.FloatingType):
            return z3.fpAbs(value) if node.operator == "abs" else z3.fpNeg(value)
        if node.operator == "~":
            result = ~value
        elif node.operator == "-":
            result = -value
        else:
            result = z3.If(value < 0, -value, value) if is_signed(node.type) else value
        return wrapped(result, node.type) if isinstance(node.type, value_types.IntegerType) else result

    def _moment(self, node: nodes.Moment, state: State) -> Value:
        left, right = self._term(node.left, state), self._term(node.right, state)
        return self._limited(node.type, left + right if node.operator == "+" else left - right, state)

    def _moment_of(self, node: nodes.MomentOf, state: State) -> Value:
        seconds, rest = self._term(node.seconds, state), self._term(node.nanoseconds, state)
        return self._of_parts(node.type, seconds, rest, state)

    def _of_parts(self, kind: Type, seconds: Term, rest: Term, state: State) -> Term:
        """Return the time of seconds and nanoseconds.

        Below 2**33 seconds, the product fits in 64 bits, and the sum in 72 bits shows an overflow. More
        seconds are out of range for all allowed nanoseconds, and are not proved.
        """
        far = either(seconds >= 1 << 33, seconds <= -(1 << 33), rest >= 1 << 62, rest <= -(1 << 62))
        known = state.where(far)
        self._ignore(known, "a time of more than 2**33 seconds in parts")
        state.require(opposite(far))
        product = seconds * integer(times.BILLION, 64)
        exact = z3.SignExt(8, product) + z3.SignExt(8, rest)
        limited = self._limited(kind, exact, state)
        return z3.Extract(63, 0, limited)

    def _limited(self, kind: Type, moment: Term, state: State) -> Term:
        limits = (0, times.MAX_TIME) if kind == value_types.TIME else (times.MIN_DURATION, times.MAX_DURATION)
        self._leave_to_python(state, either(moment < limits[0], moment > limits[1]))
        return moment

    def _compare(self, node: nodes.Compare, state: State) -> Value:
        kind = node.left.type
        if isinstance(kind, value_types.VectorType | value_types.RecordType):
            raise UnknownError(f"a comparison of values of type {kind}")
        left, right = self._term(node.left, state), self._term(node.right, state)
        return _compared(node.operator, left, right, kind)

    def _compare_texts(self, node: nodes.CompareTexts, state: State) -> Value:
        given, known = (
            (node.right, node.left) if isinstance(node.left, nodes.Literal) else (node.left, node.right)
        )
        text = known.value if isinstance(known, nodes.Literal) else None
        if node.operator in ("==", "!=") and text is None:
            return self._same_texts(node, state)
        if node.operator not in ("==", "!=") or not node.short or not isinstance(text, bytes):
            raise UnknownError("a comparison of strings")
        view = self._value(given, state)
        if isinstance(view, TextTerm) and not text:
            return view.count == 0 if node.operator == "==" else opposite(view.count == 0)
        if not isinstance(view, _View) or len(text) > nodes.SHORT:
            raise UnknownError("a comparison of strings")
        place = z3.Extract(31, 0, view.start)
        letters = [number_at(view.message, place + more, 1) == letter for more, letter in enumerate(text)]
        same = both(view.count == len(text), *letters)
        return same if node.operator == "==" else opposite(same)

    def _same_texts(self, node: nodes.CompareTexts, state: State) -> Term:
        one, other = self._value(node.left, state), self._value(node.right, state)
        if not isinstance(one, TextTerm) or not isinstance(other, TextTerm):
            raise UnknownError("a comparison of strings")
        if not node.short:
            long: Term = z3.UGT(one.count, integer(nodes.SHORT, 64))
            if isinstance(node.right, nodes.Read):
                long = both(long, z3.UGT(other.count, integer(nodes.SHORT, 64)))
            yes, no = state.where(long), state.where(opposite(long))
            self._spend(z3.UDiv(one.count, integer(BYTES_PER_INSTRUCTION, 64)), yes)
            state.join(long, yes, no)
        first = MISMATCH(one.place, other.place, z3.Extract(31, 0, one.count))
        same = both(one.count == other.count, z3.ZeroExt(32, first) == one.count)
        return same if node.operator == "==" else opposite(same)

    def _sender(self, node: nodes.SenderName, state: State) -> Value:
        return self._kept(self._beginning.senders[self._active.function.context, node.part], node.type, state)

    def _altered(self, _node: nodes.Altered, _state: State) -> Value:
        return self._beginning.altered != integer(0, 32)

    def _logical(self, node: nodes.Logical, state: State) -> Value:
        left = self._term(node.left, state)
        looked_at = left if node.operator == "and" else opposite(left)
        yes, no = state.where(looked_at), state.where(opposite(looked_at))
        right = self._term(node.right, yes)
        state.join(looked_at, yes, no)
        return both(left, right) if node.operator == "and" else either(left, right)

    def _not(self, node: nodes.Not, state: State) -> Value:
        return opposite(self._term(node.value, state))

    def _conditional(self, node: nodes.Conditional, state: State) -> Value:
        test = self._term(node.test, state)
        yes, no = state.where(test), state.where(opposite(test))
        one, other = self._value(node.yes, yes), self._value(node.no, no)
        state.join(test, yes, no)
        return choice(test, one, other)

    def _sequence(self, node: nodes.Sequence, state: State) -> Value:
        return [self._value(item, state) for item in node.items][node.chosen]

    def _discard(self, node: nodes.Discard, state: State) -> None:
        self._value(node.value, state)

    def _now(self, _node: nodes.Now, _state: State) -> Value:
        return self._beginning.now

    def _throttle(self, node: nodes.Throttle, state: State) -> Value:
        last = self._beginning.throttles.get((self._function.context, node.site))
        if last is None:
            raise UnknownError("output with a rate limit")
        seconds = self._converted(
            self._term(node.seconds, state), node.seconds.type, value_types.FloatingType(64)
        )
        more = z3.fpMul(NEAREST, seconds, floating(1e9, 64))
        until = z3.fpAdd(NEAREST, z3.fpSignedToFP(NEAREST, last, DOUBLE), more)
        # A whole number is below `until` if it is below the next whole number. A time is from 0 to below 2**62, so the
        # limits of the type do not matter, and nothing is below NaN.
        first = self._truncated(z3.fpRoundToIntegral(z3.RTP(), until), _LONG)
        now = self._beginning.now
        self._leave_to_python(state, opposite(both(last <= now, now < first)))
        return z3.BoolVal(False)

    def _item(self, node: nodes.Item, state: State) -> Value:
        view = self._value(node.base, state)
        if not isinstance(view, _View) or not isinstance(node.base.type, value_types.RecordType):
            raise UnknownError("a part of a value")
        before = self._values.fields(node.base.type)[: node.number]
        return self._part(view, sum(map(self._size, before)), node.type)

    def _part(self, view: _View, offset: Term | int, kind: Type) -> Value:
        start = view.start + offset
        if isinstance(kind, value_types.RecordType):
            return _View(view.message, start, integer(1, 64))
        if isinstance(kind, value_types.VectorType) and kind.length is not None:
            return _View(view.message, start, integer(kind.length, 64))
        return self._number(view.message, z3.Extract(31, 0, start), kind)

    def _copy(self, node: nodes.Copy, state: State) -> Value:
        view, kind = self._value(node.value, state), node.type
        if not isinstance(view, _View | TextTerm):
            raise UnknownError(f"a copy of type {kind}")
        if isinstance(kind, value_types.VectorType) and struct_code(kind.element) is not None:
            self._make(view.count * self._values.width(kind.element), state)
        elif not isinstance(kind, value_types.RecordType) or any(
            not struct_code(field) for field in self._values.fields(kind)
        ):
            raise UnknownError(f"a copy of type {kind}")
        return view

    def _call(self, node: nodes.Call, state: State) -> Value:
        name, arguments = node.function, node.arguments
        if name == "a_part":
            return self._with_part(node, state)
        if name == "l_nearest":
            raise NotProvedError("not loop-free: `nearest` reads each element")
        values = [self._value(argument, state) for argument in arguments]
        kind = arguments[0].type if arguments else value_types.VOID
        if name in _OF_VIEWS and isinstance(values[0], _View | TextTerm):
            return _OF_VIEWS[name](values[0].count)
        if name == "l_element" and isinstance(values[0], _View | TextTerm):
            return self._element(values[0], kind, _known(values[1], arguments[1].type), state)
        terms = _terms(values, name)
        rounded = name.removesuffix("f") if kind == value_types.FloatingType(32) else name
        if (
            isinstance(kind, value_types.FloatingType)
            and rounded in _ROUNDED
            and (rounded != name) == (kind.bits == 32)
        ):
            return _ROUNDED[rounded](terms[0])
        if isinstance(kind, value_types.FloatingType) and name in _QUESTIONS:
            return _QUESTIONS[name](terms[0])
        if name in ("h_copysign", "h_copysignf"):
            none = _QUESTIONS["h_isnan"](terms[1])
            self._ignore(state.where(none), "the sign of a NaN")
            state.require(opposite(none))
            return with_sign(*terms)
        if name in ("h_min", "h_max"):
            return self._chosen(_compared("<" if name == "h_min" else ">", terms[1], terms[0], kind), terms)
        if name in ("h_fmin", "h_fmax") and kind == value_types.FloatingType(64):
            less = (z3.fpLT if name == "h_fmin" else z3.fpGT)(terms[1], terms[0])
            return self._chosen(either(z3.fpIsNaN(terms[0]), less), terms)
        if name in _OF_MOMENTS:
            value = _OF_MOMENTS[name](self, terms[0])
            if isinstance(node.type, value_types.IntegerType) and width(node.type) == 32:
                return z3.Extract(31, 0, value)
            return value
        if name in ("k_after", "k_before"):
            return terms[0] + terms[1] if name == "k_after" else terms[0] - terms[1]
        raise UnknownError(name.partition("_")[2])

    def _element(self, values: _View | TextTerm, kind: Type, index: Term, state: State) -> Value:
        if not isinstance(kind, value_types.VectorType):
            raise UnknownError(f"an element of type {kind}")
        self._leave_to_python(state, z3.UGE(index, values.count))
        offset = index * self._size(kind.element)
        if isinstance(values, TextTerm):
            return self._number(MEMORY, values.place + z3.Extract(31, 0, offset), kind.element)
        return self._part(values, offset, kind.element)

    def _chosen(self, second: Term, values: Sequence[Term]) -> Term:
        return z3.If(second, values[1], values[0])

    def _with_part(self, node: nodes.Call, state: State) -> Term:
        moment, part, new = node.arguments
        assert isinstance(part, nodes.Literal)  # noqa: S101  the name of a part
        old = self._term(moment, state)
        value = self._converted(self._term(new, state), new.type, _LONG)
        seconds, rest = self._parts(old)
        one, other = (value, rest) if part.value == b"sec" else (seconds, value)
        return self._of_parts(node.type, one, other, state)

    def _invoke(self, node: nodes.Invoke, state: State) -> Value:
        if node.depth is not None:
            raise UnknownError("recursion")
        function = self._functions[node.function]
        values = [self._value(argument, state) for argument in node.arguments]
        self._calls += 1
        returned: list[tuple[State, Value]] = []
        outer, self._active = self._active, _ActiveCall(self._calls, function, returned)
        state.slots |= {
            (self._calls, name): value for name, value in zip(function.parameters, values, strict=False)
        }
        inner = state.where(z3.BoolVal(True))
        try:
            self._block(function.body, inner)
            ends: list[tuple[State, Value]] = [*returned, (inner, None)]
        finally:
            self._active = outer
        ends = [(end, value) for end, value in ends if not z3.is_false(end.alive)]
        if not ends:
            state.alive = z3.BoolVal(False)
            return MIXED
        end, result = ends[-1]
        for before, value in ends[-2::-1]:
            result = choice(before.alive, value, result)
            end = State(either(before.alive, end.alive), merged(before.alive, before, end))
        state.alive, state.slots = end.alive, end.slots
        return result


def _known(value: Value, kind: Type) -> Term:
    if not isinstance(value, Term):
        raise UnknownError(f"a value of type {kind}")
    return value


def _terms(values: Sequence[Value], function: str) -> Sequence[Term]:
    terms = [value for value in values if isinstance(value, Term)]
    if len(terms) < len(values):
        raise UnknownError(function.partition("_")[2])
    return terms


def _bits(value: Term) -> int:
    return 64 if value.sort() == DOUBLE else 32


def _compared(operator: str, left: Term, right: Term, kind: Type) -> Term:
    if isinstance(kind, value_types.BoolType) and operator not in ("==", "!="):
        left, right = map(as_bits, (left, right))
    if isinstance(kind, value_types.FloatingType):
        result: Term = _COMPARED_FLOATS[operator](left, right)
        return opposite(result) if operator == "!=" else result
    return (_COMPARED if is_signed(kind) else _COMPARED_UNSIGNED)[operator](left, right)


_COMPARED: Mapping[str, Callable[[Term, Term], Term]] = MappingProxyType(
    {
        "==": lambda left, right: left == right,
        "!=": lambda left, right: opposite(left == right),
        "<": lambda left, right: left < right,
        ">": lambda left, right: left > right,
        "<=": lambda left, right: left <= right,
        ">=": lambda left, right: left >= right,
    }
)
_COMPARED_UNSIGNED = MappingProxyType(
    {**_COMPARED, "<": z3.ULT, ">": z3.UGT, "<=": z3.ULE, ">=": z3.UGE},
)
_COMPARED_FLOATS = MappingProxyType(
    {"==": z3.fpEQ, "!=": z3.fpEQ, "<": z3.fpLT, ">": z3.fpGT, "<=": z3.fpLEQ, ">=": z3.fpGEQ}
)
_OF_INTEGERS: Mapping[str, Callable[[Term, Term], Term]] = MappingProxyType(
    {
        "+": lambda left, right: left + right,
        "-": lambda left, right: left - right,
        "*": lambda left, right: left * right,
        "&": lambda left, right: left & right,
        "|": lambda left, right: left | right,
        "^": lambda left, right: left ^ right,
    }
)
_OF_FLOATS = MappingProxyType({"+": z3.fpAdd, "-": z3.fpSub, "*": z3.fpMul, "/": z3.fpDiv})
_OF_VIEWS: Mapping[str, Callable[[Term], Term]] = MappingProxyType(
    {"l_len": lambda count: count, "l_empty": lambda count: count == 0, "l_last": lambda count: count - 1}
)
_ROUNDED: Mapping[str, Callable[[Term], Term]] = MappingProxyType(
    {
        "h_sqrt": lambda value: z3.fpSqrt(NEAREST, value),
        "h_fabs": z3.fpAbs,
        "h_floor": lambda value: z3.fpRoundToIntegral(z3.RTN(), value),
        "h_ceil": lambda value: z3.fpRoundToIntegral(z3.RTP(), value),
        "h_trunc": lambda value: z3.fpRoundToIntegral(z3.RTZ(), value),
        "h_rint": lambda value: z3.fpRoundToIntegral(NEAREST, value),
        "h_nearbyint": lambda value: z3.fpRoundToIntegral(NEAREST, value),
    }
)
_QUESTIONS: Mapping[str, Callable[[Term], Term]] = MappingProxyType(
    {
        "h_isnan": lambda value: opposite(z3.fpLEQ(z3.fpAbs(value), floating(inf, _bits(value)))),
        "h_isinf": lambda value: z3.fpEQ(z3.fpAbs(value), floating(inf, _bits(value))),
        "h_isfinite": lambda value: z3.fpLT(z3.fpAbs(value), floating(inf, _bits(value))),
    }
)
"""Comparisons with infinity, as in the module: if z3 knows nothing about floats, only equal terms are equal."""
_OF_MOMENTS: Mapping[str, Callable[[FormTerms, Term], Term]] = MappingProxyType(
    {
        "m_is_zero": lambda _, value: value == 0,
        "m_whole": lambda _, value: value,
        "m_seconds": lambda _, value: SECONDS(value),
        "m_sec": lambda meaning, value: meaning._parts(value)[0],
        "m_nsec": lambda meaning, value: meaning._parts(value)[1],
    }
)

STATEMENTS: Mapping[type[nodes.FormNode], Callable[[FormTerms, Any, State], None] | nodes.Left] = (
    MappingProxyType(
        {
            nodes.Evaluate: FormTerms._evaluate,
            nodes.If: FormTerms._if,
            nodes.Loop: FormTerms._loop,
            nodes.ForEach: FormTerms._repeat,
            nodes.Break: FormTerms._break,
            nodes.Continue: FormTerms._continue,
            nodes.Select: FormTerms._select,
            nodes.Return: FormTerms._return,
            nodes.Leave: FormTerms._leave,
            nodes.Charge: FormTerms._charge,
            nodes.Allocate: FormTerms._allocate,
            nodes.LimitDepth: nodes.Left("recursion"),
            nodes.Drop: FormTerms._drop,
            nodes.Reset: nodes.Left("a reset"),
            nodes.StopMessage: FormTerms._stop,
            nodes.Publish: nodes.Left("a message to publish"),
            nodes.AfterText: FormTerms._after_text,
            nodes.Count: FormTerms._count,
            nodes.AfterElements: FormTerms._after_elements,
            nodes.Skip: FormTerms._repeat,
            nodes.NotPast: FormTerms._not_past,
            nodes.Ends: FormTerms._ends,
            nodes.ReadNumbers: FormTerms._read_numbers,
            nodes.ReadValue: FormTerms._read_value,
            nodes.Require: FormTerms._require,
            nodes.Pending: FormTerms._pending,
            nodes.WriteBack: FormTerms._write_back,
        }
    )
)
EXPRESSIONS: Mapping[type[nodes.FormNode], Callable[[FormTerms, Any, State], Value] | nodes.Left] = (
    MappingProxyType(
        {
            nodes.Literal: FormTerms._literal,
            nodes.Read: FormTerms._read,
            nodes.Assign: FormTerms._assign,
            nodes.Convert: FormTerms._convert,
            nodes.Arithmetic: FormTerms._arithmetic,
            nodes.Unary: FormTerms._unary,
            nodes.Moment: FormTerms._moment,
            nodes.MomentOf: FormTerms._moment_of,
            nodes.Compare: FormTerms._compare,
            nodes.CompareTexts: FormTerms._compare_texts,
            nodes.Logical: FormTerms._logical,
            nodes.Not: FormTerms._not,
            nodes.Conditional: FormTerms._conditional,
            nodes.Sequence: FormTerms._sequence,
            nodes.Discard: FormTerms._discard,
            nodes.Item: FormTerms._item,
            nodes.Vector: nodes.Left("an array that is built"),
            nodes.Zero: FormTerms._zero,
            nodes.Copy: FormTerms._copy,
            nodes.Recast: nodes.Left("a converted array of bytes"),
            nodes.OfType: nodes.Left("a function for values of any type"),
            nodes.Call: FormTerms._call,
            nodes.Accumulate: FormTerms._repeat,
            nodes.Invoke: FormTerms._invoke,
            nodes.Format: nodes.Left("formatted text"),
            nodes.Join: nodes.Left("joined strings"),
            nodes.Log: FormTerms._log,
            nodes.Throttle: FormTerms._throttle,
            nodes.Now: FormTerms._now,
            nodes.SenderName: FormTerms._sender,
            nodes.Altered: FormTerms._altered,
            nodes.Whole: nodes.Left("MESSAGE"),
        }
    )
)
