"""Translate a function of a WebAssembly module to terms of z3.

Memory has these parts; access to any other address counts as a difference:

- cells, 8 bytes each at constant addresses: variables, budgets, times, and the end of the log (`UNDO`);
- the message, from the address that the function gets, within its size;
- lines of output, in order;
- the log, which restores a message that is left: an entry with address, size and old bytes precedes each write to the
message, and is never overwritten.

Elements of arrays in variables or constants are bytes of `MEMORY`; code that reads other bytes there is not
proved. Strings are only compared, by a function that is not translated (`MISMATCH`). A trap is treated like a
message that is left (`ELSEWHERE`): the effects are undone.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType

import z3

from rosmop.prove.decoding import Code, WasmInstruction
from rosmop.prove.loops import Cut, GrowingList, Loops, become, constant_for
from rosmop.prove.terms import (
    AT,
    DOUBLE,
    FRAME,
    MEMORY,
    MIXED,
    NEAREST,
    SINGLE,
    DiffersError,
    Mixed,
    NotProvedError,
    Sort,
    State,
    Term,
    as_bits,
    as_term,
    both,
    choice,
    either,
    floating,
    integer,
    merge,
    number_at,
    opposite,
    with_number,
    with_sign,
)

POSITION, UNDO, SAID = 0, 8, 12

_ENTRY = 16  # bytes of an entry: address, size (4 bytes each), old bytes
_MESSAGE, _NOTE, _LINES = "message", "note", "lines"
_SORTS: Mapping[str, Sort] = MappingProxyType(
    {"i32": z3.BitVecSort(32), "i64": z3.BitVecSort(64), "f32": SINGLE, "f64": DOUBLE}
)


@dataclass(frozen=True)
class Pointer:
    """An offset from the start of the message, or of the next entry of the log."""

    place: str
    offset: Term


Value = Term | Pointer | Mixed
"""A value on the stack of the module."""


@dataclass(frozen=True)
class _Note:
    """The last entry of the log: position, size and old bytes of the write that it announces."""

    alive: Term
    position: Term
    size: int
    old: Term


@dataclass(frozen=True)
class ReadableBytes:
    """Bytes of `MEMORY` that code may read, under a condition on their length."""

    begin: Term
    size: Term
    known: Term


@dataclass(frozen=True)
class LoopGuess:
    """Names of variables on both sides, and the form's loops, to guess equal values at the head of a loop."""

    cuts: Sequence[Cut]
    variables: Mapping[int, object]
    names: Sequence[Sequence[str]]
    unrolled: int = 0


@dataclass(frozen=True)
class ModuleResult:
    """The return value `bits` of a function, unless it `trapped`. `outside` means a read beyond the message."""

    trapped: Term
    outside: Term
    bits: Term
    message: Term
    cells: Mapping[int, object]
    stored: frozenset[int]
    lines: Term
    said: Term
    loops: Loops


@dataclass(frozen=True)
class _ActiveCall:
    """A call that is being translated; `frame` is its number, and `function` that of its function.

    `labels` have the states that leave each block around the instruction, `returned` those that return, with the value.
    """

    frame: int
    function: int
    labels: list[list[State]] = field(default_factory=list)
    returned: list[tuple[State, Value]] = field(default_factory=list)


class ModuleExecution:
    """Executes the function of one event on these cells. Raises `DiffersError` and `NotProvedError`.

    `strings` are the addresses of strings, and of the cells that refer to arrays; code may read `spans`
    there. `routines` has a function of z3 for each function that is not translated, by its number.
    """

    def __init__(  # noqa: PLR0917  a function, its message and its cells
        self,
        functions: Sequence[Code],
        number: int,
        message: Term,
        size: Term,
        cells: Mapping[int, Term],
        strings: Sequence[range],
        routines: Mapping[int, Callable[..., Term]],
        spans: Sequence[ReadableBytes],
        guess: LoopGuess,
    ) -> None:
        self._functions = functions
        self._strings = strings
        self._routines = routines
        self._spans = spans
        self._guess = guess
        self._loops = Loops(guess.unrolled)
        self._active = _ActiveCall(0, number)
        self._size = size
        self._trapped: list[Term] = []
        self._outside: list[Term] = []
        self._stored: set[int] = set()
        self._frames = 0
        slots: dict[object, object] = {
            _MESSAGE: message,
            _LINES: z3.Array("lines", z3.BitVecSort(32), z3.BitVecSort(8)),
        }
        slots |= {("cell", UNDO): Pointer("log", integer(0, 32))}
        slots |= {
            ("cell", SAID): Pointer("lines", integer(0, 32)),
            ("cell", POSITION): FRAME,
        }
        slots |= {("cell", address): value for address, value in cells.items()}
        self._state = State(z3.BoolVal(True), slots)
        self._number = number

    def run(self) -> ModuleResult:
        state = self._state
        bits = _bits(self._call(self._number, [Pointer("message", integer(0, 32)), self._size], state))
        cells = {
            key[1]: value
            for key, value in state.slots.items()
            if isinstance(key, tuple) and key[0] == "cell" and key[1] not in (POSITION, UNDO, SAID)
        }
        return ModuleResult(
            either(*self._trapped), either(*self._outside), bits, state.term(_MESSAGE), cells,
            frozenset(self._stored), state.term(_LINES), _pointer(state, SAID).offset, self._loops,
        )  # fmt: skip

    def _call(self, number: int, arguments: Sequence[Value], state: State) -> Value:
        code = self._functions[number]
        self._frames += 1
        outer, self._active = self._active, _ActiveCall(self._frames, number)
        frame = self._active.frame
        zeros = [integer(0, 32) if kind == "i32" else integer(0, 64) if kind == "i64" else floating(0.0, int(kind[1:]))
                 for kind in code.made]  # fmt: skip
        inner = state.where(z3.BoolVal(True))
        inner.slots |= {(frame, place): value for place, value in enumerate([*arguments, *zeros])}
        stack: list[Value] = []
        self._run(code.body, inner, stack)
        ends = [*self._active.returned, *([] if z3.is_false(inner.alive) else [(inner, stack[-1])])]
        self._active = outer
        if not ends:
            state.alive = z3.BoolVal(False)
            return integer(0, 32)
        end, result = ends[-1]
        for before, value in ends[-2::-1]:
            result = choice(before.alive, value, result)
            end = State(either(before.alive, end.alive), merge(before.alive, before, end))
        state.alive, state.slots = end.alive, end.slots
        return result

    def _run(self, instructions: Sequence[WasmInstruction], state: State, stack: list[Value]) -> None:
        for instruction in instructions:
            if z3.is_false(state.alive):
                return
            family, _, rest = instruction.name.partition(".")
            method = _CONTROL.get(instruction.name)
            if method is not None:
                method(self, instruction, state, stack)
            elif rest.startswith("load"):
                stack.append(self._load(family, rest[4:], instruction.operands[0], stack.pop(), state))
            elif rest.startswith("store"):
                value = stack.pop()
                self._store(family, rest[5:], instruction.operands[0], stack.pop(), value, state)
            else:
                if rest.startswith(("div_", "rem_")):
                    self._divides(rest, state, stack)
                stack.append(_calculate(family, rest, instruction.operands, stack))

    def _divides(self, name: str, state: State, stack: Sequence[Value]) -> None:
        left, right = _bits(stack[-2]), _bits(stack[-1])
        traps: Term = right == 0
        if name == "div_s":
            traps = either(traps, both(right == -1, left == 1 << left.size() - 1))
        self._trapped.append(both(state.alive, traps))
        state.require(opposite(traps))

    # Control

    def _if(self, instruction: WasmInstruction, state: State, stack: list[Value]) -> None:
        test = _truth(stack.pop())
        yes, no = state.where(test), state.where(opposite(test))
        one: list[Value] = []
        other: list[Value] = []
        self._active.labels.append([])
        self._run(instruction.body, yes, one)
        self._run(instruction.otherwise, no, other)
        if self._active.labels.pop():
            raise NotProvedError("leaves a branch before its end")
        state.join(test, yes, no)
        values = [branch[-1] if branch and not z3.is_false(end.alive) else None
                  for branch, end in ((one, yes), (other, no))]  # fmt: skip
        if any(value is not None for value in values):
            stack.append(choice(test, *values))

    def _block(self, instruction: WasmInstruction, state: State, stack: list[Value]) -> None:
        self._active.labels.append([])
        self._run(instruction.body, state, [])
        become(state, [*self._active.labels.pop(), state])

    def _loop(self, instruction: WasmInstruction, state: State, stack: list[Value]) -> None:
        def body(state: State) -> tuple[Sequence[State], Sequence[State]]:
            self._active.labels.append([])
            try:
                self._run(instruction.body, state, [])
            finally:
                again = self._active.labels.pop()
            return again, [state]

        logs: list[GrowingList] = [self._trapped, self._outside, self._active.returned, *self._active.labels]
        self._loops.run(state, body, self._active.frame, self._at_head, logs)

    def _at_head(self, number: int, key: object, value: object) -> Term | Mixed:
        if key in (_MESSAGE, _LINES, _NOTE, ("cell", SAID), ("cell", UNDO)):
            raise NotProvedError("not loop-free: a loop changes the message or prints")
        cut = self._guess.cuts[number] if number < len(self._guess.cuts) else None
        if cut is None:
            raise NotProvedError("not loop-free: it compares or copies strings, byte by byte")
        assert isinstance(key, tuple)  # noqa: S101  a cell, a part of a note, or a variable of a call
        kind, place = key
        if kind == "cell":
            name = self._guess.variables.get(place)
        else:
            name = self._guess.names[self._active.function][place] if kind == self._active.frame else None
        for known in ((cut.frame, name), name):
            meant = cut.head.get(known)
            if isinstance(meant, Term) and isinstance(value, Term) and _same_sort(meant, value):
                return meant
        return constant_for(key, value)

    def _branch(self, instruction: WasmInstruction, state: State, stack: list[Value]) -> None:
        self._active.labels[-1 - int(instruction.operands[0])].append(state.where(z3.BoolVal(True)))
        state.alive = z3.BoolVal(False)

    def _branch_if(self, instruction: WasmInstruction, state: State, stack: list[Value]) -> None:
        test = _truth(stack.pop())
        self._active.labels[-1 - int(instruction.operands[0])].append(state.where(test))
        state.require(opposite(test))

    def _unreachable(self, instruction: WasmInstruction, state: State, stack: list[Value]) -> None:
        self._trapped.append(state.alive)
        state.alive = z3.BoolVal(False)

    def _return(self, instruction: WasmInstruction, state: State, stack: list[Value]) -> None:
        self._active.returned.append((state.where(z3.BoolVal(True)), stack[-1]))
        state.alive = z3.BoolVal(False)

    def _called(self, instruction: WasmInstruction, state: State, stack: list[Value]) -> None:
        number = int(instruction.operands[0])
        count = len(self._functions[number].parameters)
        arguments = stack[len(stack) - count :]
        del stack[len(stack) - count :]
        if number in self._routines:
            if any(isinstance(argument, Pointer) or argument is MIXED for argument in arguments):
                raise NotProvedError("not loop-free: it compares or copies strings, byte by byte")
            stack.append(self._routines[number](*map(_bits, arguments)))
            return
        stack.append(self._call(number, arguments, state))

    def _drop(self, instruction: WasmInstruction, state: State, stack: list[Value]) -> None:
        stack.pop()

    def _select(self, instruction: WasmInstruction, state: State, stack: list[Value]) -> None:
        test, no, yes = _truth(stack.pop()), stack.pop(), stack.pop()
        stack.append(choice(test, yes, no))

    def _get(self, instruction: WasmInstruction, state: State, stack: list[Value]) -> None:
        stack.append(_number_or_address(state.slots[self._active.frame, instruction.operands[0]]))

    def _set(self, instruction: WasmInstruction, state: State, stack: list[Value]) -> None:
        state.slots[self._active.frame, instruction.operands[0]] = stack.pop()

    # Memory

    def _load(self, family: str, how: str, offset: float, address: Value, state: State) -> Value:
        bits = int(family[1:])
        if isinstance(address, Pointer):
            if address.place != "message":
                raise DiffersError("it reads its own log")
            size = int(how.partition("_")[0] or bits) // 8
            number = number_at(state.term(_MESSAGE), self._within(address, int(offset), size, state), size)
            return _load(number, family, how)
        span = self._span(address)
        if span is not None:
            size = int(how.partition("_")[0] or bits) // 8
            return _load(
                number_at(MEMORY, self._in_span(as_term(address), int(offset), size, span, state), size),
                family,
                how,
            )
        place = self._cell(address, int(offset))
        known = state.slots.get(("cell", place))
        value = None if known is None else _number_or_address(known)
        if (family, how) == ("i64", "32_u") and value is not None and _fits(value, "i32"):
            if isinstance(value, Pointer):
                raise DiffersError("it calculates with an address")
            return z3.ZeroExt(32, _bits(value))
        if how or value is None or not _fits(value, family):
            raise DiffersError(f"it reads {each_name(family, how)} at {place}, where no such value is stored")
        return value

    def _store(  # noqa: PLR0917  the operands of the instruction
        self, family: str, how: str, offset: float, address: Value, value: Value, state: State
    ) -> None:
        size = int(how or family[1:]) // 8
        if isinstance(address, Pointer) and address.place == "lines":
            begin = address.offset + integer(int(offset), 32)
            state.slots[_LINES] = with_number(state.term(_LINES), begin, _store(value, size))
            return
        if isinstance(address, Pointer):
            (self._write if address.place == "message" else self._note)(
                address, int(offset), size, value, state
            )
            return
        place = self._cell(address, int(offset))
        if place == UNDO and not how:
            self._add_note(value, state)
            return
        known = state.slots.get(("cell", place))
        before = None if known is None else _number_or_address(known)
        if isinstance(value, Pointer) and value.place == "message" and z3.is_bv(before):
            value = AT + value.offset
        if how or before is None or not _fits(before, family):
            raise DiffersError(
                f"it writes {each_name(family, how)} at {place}, where no such value is stored"
            )
        if place == SAID and (not isinstance(value, Pointer) or value.place != "lines"):
            raise DiffersError("the output is logged elsewhere")
        state.slots["cell", place] = value
        if place != SAID:
            self._stored.add(place)

    def _cell(self, address: Value, offset: int) -> int:
        number = z3.simplify(_bits(address))
        known = z3.is_bv_value(number)
        place = int(number.as_long()) + offset if known else -1
        if any(place in string for string in self._strings) or (self._strings and not known):
            raise NotProvedError("uses a constant string or array, or one that is kept")
        if not known:
            raise DiffersError("it reads an address outside the message")
        return place

    def _span(self, address: Value) -> ReadableBytes | None:
        if not isinstance(address, Term):
            return None
        return next((one for one in self._spans for part in _summands(address) if part.eq(one.begin)), None)

    def _in_span(self, address: Term, offset: int, size: int, span: ReadableBytes, state: State) -> Term:
        """Return the address, which must be in the span. An address before its begin is a very large offset."""
        end = z3.ZeroExt(32, address - span.begin) + integer(offset + size, 64)
        self._outside.append(both(state.alive, either(opposite(span.known), z3.UGT(end, span.size))))
        return address + integer(offset, 32) if offset else address

    def _within(self, pointer: Pointer, offset: int, size: int, state: State) -> Term:
        end = z3.ZeroExt(32, pointer.offset) + integer(offset + size, 64)
        self._outside.append(both(state.alive, z3.UGT(end, z3.ZeroExt(32, self._size))))
        return pointer.offset + integer(offset, 32) if offset else pointer.offset

    def _write(self, pointer: Pointer, offset: int, size: int, value: Value, state: State) -> None:
        position = self._within(pointer, offset, size, state)
        note, message = state.slots.get(_NOTE), state.term(_MESSAGE)
        old = number_at(message, position, size)
        if (
            not isinstance(note, _Note)
            or not note.alive.eq(state.alive)
            or note.size != size
            or not _same(note.position, position)
            or not _same(note.old, old if size == 8 else z3.ZeroExt(64 - 8 * size, old))
        ):
            raise DiffersError("it writes bytes of the message that were not logged before")
        state.slots[_MESSAGE] = with_number(message, position, z3.Extract(8 * size - 1, 0, _bits(value)))

    def _note(self, pointer: Pointer, offset: int, size: int, value: Value, state: State) -> None:
        begin = _pointer(state, UNDO).offset
        part = z3.simplify(pointer.offset + offset - begin)
        if not z3.is_bv_value(part) or (part.as_long(), size) not in ((0, 4), (4, 4), (8, 8)):
            raise DiffersError("it writes outside the next entry of the log")
        state.slots["part", part.as_long()] = value

    def _add_note(self, value: Value, state: State) -> None:
        begin = _pointer(state, UNDO).offset
        address, size, old = (state.slots.get(("part", part)) for part in (0, 4, 8))
        size = size if size is None else z3.simplify(_bits(_number_or_address(size)))
        if (
            not isinstance(value, Pointer)
            or not _same(value.offset, begin + _ENTRY)
            or not isinstance(address, Pointer)
            or not isinstance(size, Term)
            or not z3.is_bv_value(size)
            or not isinstance(old, Term)
        ):
            raise DiffersError("the end of the log is set where no entry ends")
        state.slots[_NOTE] = _Note(state.alive, address.offset, size.as_long(), old)
        state.slots["cell", UNDO] = value
        for part in (0, 4, 8):
            del state.slots["part", part]


def _pointer(state: State, cell: int) -> Pointer:
    pointer = state.slots["cell", cell]
    if not isinstance(pointer, Pointer):
        raise NotProvedError("uses a variable for an address and a number")
    return pointer


def _number_or_address(value: object) -> Term | Pointer:
    return value if isinstance(value, Pointer) else as_term(value)


def _summands(term: Term) -> Iterator[Term]:
    if z3.is_app_of(term, z3.Z3_OP_BADD):
        for part in term.children():
            yield from _summands(part)
    else:
        yield term


def _same_sort(one: Term, other: Term) -> bool:
    sorts = [z3.BitVecSort(32) if z3.is_bool(value) else value.sort() for value in (one, other)]
    return bool(sorts[0] == sorts[1])


def _load(value: Term, family: str, how: str) -> Term:
    if family in ("f32", "f64"):
        return z3.fpBVToFP(value, _SORTS[family])
    missing = int(family[1:]) - value.size()
    return value if not missing else (z3.SignExt if how.endswith("_s") else z3.ZeroExt)(missing, value)


def _store(value: Value, size: int) -> Term:
    if isinstance(value, Pointer):
        if value.place != "message":
            raise DiffersError("it logs an address outside the message")
        value = AT + value.offset
    elif z3.is_fp(value):
        value = z3.fpToIEEEBV(as_term(value))
    return z3.Extract(8 * size - 1, 0, _bits(value))


def each_name(family: str, how: str) -> str:
    return f"{how.strip('_us') or family[1:]} bits"


def _same(one: Term, other: Term) -> bool:
    rest = z3.simplify(one - other)
    return bool(z3.is_bv_value(rest) and rest.as_long() == 0)


def _fits(value: Term | Pointer, family: str) -> bool:
    if isinstance(value, Pointer) or z3.is_bool(value):
        return family == "i32"
    return value.sort() == _SORTS[family]


def _operand(value: Value) -> Term:
    if isinstance(value, Pointer):
        raise DiffersError("it calculates with an address")
    return as_term(value)


def _bits(value: Value) -> Term:
    term = _operand(value)
    return as_bits(term) if z3.is_bool(term) else term


def _truth(value: Value) -> Term:
    return as_term(value) if z3.is_bool(value) else opposite(_bits(value) == 0)


def _calculate(family: str, name: str, operands: Sequence[float], stack: list[Value]) -> Value:
    if name == "const":
        bits = int(family[1:])
        return integer(int(operands[0]), bits) if family[0] == "i" else floating(operands[0], bits)
    right = stack.pop()
    unary = _UNARY.get(f"{family}.{name}") or _UNARY.get(name)
    if unary is not None and (family[0] == "f" or name not in _FLOATS_ALONE):
        return unary(_operand(right))
    left = stack.pop()
    if family == "i32" and name == "add":
        pointer, more = (right, left) if isinstance(right, Pointer) else (left, right)
        if isinstance(pointer, Pointer):
            return Pointer(pointer.place, pointer.offset + _bits(more))
    if name == "gt_u" and isinstance(left, Pointer) and left.place == "lines":
        return z3.FreshBool("full")
    if family == "i32" and z3.is_bool(left) and z3.is_bool(right) and name in ("and", "or"):
        return both(left, right) if name == "and" else either(left, right)
    operation = (_OF_FLOATS if family[0] == "f" else _OF_INTEGERS).get(name)
    if operation is None:
        raise NotProvedError(f"uses the instruction {family}.{name}")
    return operation(_bits(left), _bits(right))


def _cut(value: Term, bits: int, *, signed: bool) -> Term:
    least, most = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    whole = (z3.fpToSBV if signed else z3.fpToUBV)(z3.RTZ(), value, z3.BitVecSort(bits))
    # A value between a limit and the next whole number can only be cut to the limit.
    high, low = z3.fpGEQ(value, floating(most, 64)), z3.fpLEQ(value, floating(least, 64))
    fitting = z3.If(low, integer(least, bits), z3.If(high, integer(most, bits), whole))
    return z3.If(z3.fpIsNaN(value), integer(0, bits), fitting)


def _converting(to: Callable[..., Term], sort: Sort) -> Callable[[Term], Term]:
    return lambda value: to(NEAREST, _bits(value), sort)


def _shift(operation: Callable[[Term, Term], Term]) -> Callable[[Term, Term], Term]:
    return lambda value, amount: operation(value, amount & (amount.size() - 1))


_CONTROL: Mapping[str, Callable[[ModuleExecution, WasmInstruction, State, list[Value]], None]] = (
    MappingProxyType(
        {
            "if": ModuleExecution._if,
            "block": ModuleExecution._block,
            "loop": ModuleExecution._loop,
            "br": ModuleExecution._branch,
            "br_if": ModuleExecution._branch_if,
            "unreachable": ModuleExecution._unreachable,
            "return": ModuleExecution._return,
            "call": ModuleExecution._called,
            "drop": ModuleExecution._drop,
            "select": ModuleExecution._select,
            "local.get": ModuleExecution._get,
            "local.set": ModuleExecution._set,
        }
    )
)

_FLOATS_ALONE = frozenset({"abs", "neg", "ceil", "floor", "trunc", "nearest", "sqrt"})
_UNARY: Mapping[str, Callable[[Term], Term]] = MappingProxyType(
    {
        "eqz": lambda value: opposite(_truth(value)),
        "wrap_i64": lambda value: z3.Extract(31, 0, value),
        "extend_i32_s": lambda value: z3.SignExt(32, _bits(value)),
        "extend_i32_u": lambda value: z3.ZeroExt(32, _bits(value)),
        "extend8_s": lambda value: z3.SignExt(24, z3.Extract(7, 0, _bits(value))),
        "extend16_s": lambda value: z3.SignExt(16, z3.Extract(15, 0, _bits(value))),
        "reinterpret_f32": z3.fpToIEEEBV,
        "reinterpret_f64": z3.fpToIEEEBV,
        "demote_f64": lambda value: z3.fpFPToFP(NEAREST, value, SINGLE),
        "promote_f32": lambda value: z3.fpFPToFP(NEAREST, value, DOUBLE),
        **{
            f"{family}.convert_{source}_{sign}": _converting(to, _SORTS[family])
            for family in ("f32", "f64")
            for source in ("i32", "i64")
            for sign, to in (("s", z3.fpSignedToFP), ("u", z3.fpUnsignedToFP))
        },
        **{
            f"{family}.trunc_sat_f64_{sign}": partial(_cut, bits=int(family[1:]), signed=sign == "s")
            for family in ("i32", "i64")
            for sign in ("s", "u")
        },
        "abs": z3.fpAbs,
        "neg": z3.fpNeg,
        "sqrt": lambda value: z3.fpSqrt(NEAREST, value),
        "ceil": lambda value: z3.fpRoundToIntegral(z3.RTP(), value),
        "floor": lambda value: z3.fpRoundToIntegral(z3.RTN(), value),
        "trunc": lambda value: z3.fpRoundToIntegral(z3.RTZ(), value),
        "nearest": lambda value: z3.fpRoundToIntegral(NEAREST, value),
    }
)
_OF_INTEGERS: Mapping[str, Callable[[Term, Term], Term]] = MappingProxyType(
    {
        "eq": lambda left, right: left == right,
        "ne": lambda left, right: opposite(left == right),
        "lt_s": lambda left, right: left < right,
        "lt_u": z3.ULT,
        "gt_s": lambda left, right: left > right,
        "gt_u": z3.UGT,
        "le_s": lambda left, right: left <= right,
        "le_u": z3.ULE,
        "ge_s": lambda left, right: left >= right,
        "ge_u": z3.UGE,
        "add": lambda left, right: left + right,
        "sub": lambda left, right: left - right,
        "mul": lambda left, right: left * right,
        "div_s": lambda left, right: left / right,
        "div_u": z3.UDiv,
        "rem_s": z3.SRem,
        "rem_u": z3.URem,
        "and": lambda left, right: left & right,
        "or": lambda left, right: left | right,
        "xor": lambda left, right: left ^ right,
        "shl": _shift(lambda left, right: left << right),
        "shr_s": _shift(lambda left, right: left >> right),
        "shr_u": _shift(z3.LShR),
    }
)
_OF_FLOATS: Mapping[str, Callable[[Term, Term], Term]] = MappingProxyType(
    {
        "eq": z3.fpEQ,
        "ne": lambda left, right: opposite(z3.fpEQ(left, right)),
        "lt": z3.fpLT,
        "gt": z3.fpGT,
        "le": z3.fpLEQ,
        "ge": z3.fpGEQ,
        "add": lambda left, right: z3.fpAdd(NEAREST, left, right),
        "sub": lambda left, right: z3.fpSub(NEAREST, left, right),
        "mul": lambda left, right: z3.fpMul(NEAREST, left, right),
        "div": lambda left, right: z3.fpDiv(NEAREST, left, right),
        "copysign": with_sign,
    }
)
