"""The scalar part of the form as a WebAssembly module: numbers, conditions, loops, fields that are numbers, drops.

`module_of` writes functions of events and what they call; `NotScalarError` names what is beyond this part (strings,
vectors, whole messages, output, recursion). The module has no imports.

- The export of an event takes where the message is in `memory` and its size (i32, i32), and returns bits (i32): it
  happened (1), drops the message (2), has made its bytes others (4).
- A variable of the set stands at its address, in 8 bytes.
- A fault is a trap; before it the site is stored at 0 and the reason (of `REASONS`) at 4. A trap of the runtime's own
  (no fuel is left) stores nothing.

Work and memory are bounded by the runtime (fuel, limits of the store), so what the form charges is not written.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from appliance.rosmop.ir import form
from appliance.rosmop.ir.values import BILLION, struct_code, struct_size
from appliance.rosmop.runtime.wire import MAX_EMPTY
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type

VARIABLES = 8
"""The address of the first variable."""

REASONS = ("", "division by zero", "the bytes are not a message of this type")

_I32, _I64, _F32, _F64 = 0x7F, 0x7E, 0x7D, 0x7C
_IF, _ELSE, _END, _RETURN, _DROP, _SELECT = b"\x04", b"\x05", b"\x0b", b"\x0f", b"\x1a", b"\x1b"
_NOTHING = b"\x40"
_UNREACHABLE = b"\x00"
_COMPARE = {
    _I32: {"==": 0x46, "!=": 0x47, "<": 0x48, ">": 0x4A, "<=": 0x4C, ">=": 0x4E},
    _I64: {"==": 0x51, "!=": 0x52, "<": 0x53, ">": 0x55, "<=": 0x57, ">=": 0x59},
    _F32: {"==": 0x5B, "!=": 0x5C, "<": 0x5D, ">": 0x5E, "<=": 0x5F, ">=": 0x60},
    _F64: {"==": 0x61, "!=": 0x62, "<": 0x63, ">": 0x64, "<=": 0x65, ">=": 0x66},
}
_CALCULATE = {
    _I32: {"+": 0x6A, "-": 0x6B, "*": 0x6C, "/": 0x6D, "%": 0x6F, "&": 0x71, "|": 0x72, "^": 0x73, "<<": 0x74,
           ">>": 0x75},
    _I64: {"+": 0x7C, "-": 0x7D, "*": 0x7E, "/": 0x7F, "%": 0x81, "&": 0x83, "|": 0x84, "^": 0x85, "<<": 0x86,
           ">>": 0x87},
    _F32: {"+": 0x92, "-": 0x93, "*": 0x94, "/": 0x95},
    _F64: {"+": 0xA0, "-": 0xA1, "*": 0xA2, "/": 0xA3},
}  # fmt: skip
_LOAD = {"?": 0x2D, "b": 0x2C, "B": 0x2D, "h": 0x2E, "H": 0x2F, "i": 0x28, "I": 0x28, "q": 0x29, "Q": 0x29, "f": 0x2A,
         "d": 0x2B}  # fmt: skip
_STORE = {1: 0x3A, 2: 0x3B, 4: 0x36, 8: 0x37}

_ABS, _NEG = {_F32: 0x8B, _F64: 0x99}, {_F32: 0x8C, _F64: 0x9A}


class NotScalarError(Exception):
    """A function has something that this part of the form does not have."""


@dataclass(frozen=True)
class WasmModule:
    """A module: its bytes, and where it keeps the variables of the set."""

    code: bytes
    addresses: Mapping[str, tuple[int, Type]]


def module_of(
    functions: Mapping[str, form.Function], events: Sequence[str], shared: frozenset[str]
) -> WasmModule:
    """The module of these events; `shared` are the names of the variables of the set. Raises `NotScalarError`."""
    writer = _Writer(functions, shared)
    for name in events:
        writer.index_of(name, (_I32, _I32), _I32)
    bodies = []
    for function, parameters, result in writer.waiting:  # grows while functions call others
        bodies.append(_Body(writer, functions[function], parameters, result).code())
    types = [b"\x60" + _row([bytes((one,)) for one in given]) + _row([bytes((result,))])
             for _, given, result in writer.waiting]  # fmt: skip
    exports = [_name(name) + b"\x00" + _unsigned(index) for index, name in enumerate(events)]
    sections = (
        (1, _row(types)),
        (3, _row([_unsigned(index) for index in range(len(types))])),
        (5, _row([b"\x00\x01"])),
        (7, _row([*exports, _name("memory") + b"\x02\x00"])),
        (10, _row(bodies)),
    )
    code = b"".join(bytes((number,)) + _unsigned(len(content)) + content for number, content in sections)
    return WasmModule(b"\0asm\x01\0\0\0" + code, MappingProxyType(writer.addresses))


def _unsigned(value: int) -> bytes:
    """LEB128."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*out, value))


def _signed(value: int) -> bytes:
    out = bytearray()
    while not -64 <= value < 64:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*out, value & 0x7F))


def _row(items: Sequence[bytes]) -> bytes:
    return _unsigned(len(items)) + b"".join(items)


def _name(name: str) -> bytes:
    return _unsigned(len(name)) + name.encode()


def _wasm(kind: Type) -> int:
    """The type of the machine for one of the language."""
    if isinstance(kind, kinds.Bool) or (isinstance(kind, kinds.Integer) and kind.bits <= 32):
        return _I32
    if isinstance(kind, kinds.Integer | kinds.Time | kinds.Duration):
        return _I64
    if isinstance(kind, kinds.Floating):
        return _F32 if kind.bits == 32 else _F64
    raise NotScalarError(str(kind))


def _is_signed(kind: Type) -> bool:
    return not isinstance(kind, kinds.Integer) or kind.signed


def _constant(machine: int, value: float) -> bytes:
    if machine in (_I32, _I64):
        bits = 32 if machine == _I32 else 64
        whole = int(value) & (1 << bits) - 1
        return (b"\x41" if bits == 32 else b"\x42") + _signed(whole - (whole >> bits - 1 << bits))
    return b"\x43" + struct.pack("<f", value) if machine == _F32 else b"\x44" + struct.pack("<d", value)


class _Writer:
    """The functions that are needed, in the order of their numbers, and the addresses of variables."""

    def __init__(self, functions: Mapping[str, form.Function], shared: frozenset[str]) -> None:
        self.functions = functions
        self.shared = shared
        self.addresses: dict[str, tuple[int, Type]] = {}
        self.waiting: list[tuple[str, tuple[int, ...], int]] = []

    def index_of(self, name: str, parameters: tuple[int, ...], result: int) -> int:
        """The number of a function."""
        key = (name, parameters, result)
        if key not in self.waiting:
            self.waiting.append(key)
        return self.waiting.index(key)

    def address(self, name: str, kind: Type) -> int:
        """Where a variable of the set stands."""
        _wasm(kind)
        return self.addresses.setdefault(name, (VARIABLES + 8 * len(self.addresses), kind))[0]


class _Body:
    """Writes one function."""

    def __init__(
        self, writer: _Writer, function: form.Function, parameters: tuple[int, ...], result: int
    ) -> None:
        self._writer = writer
        self._function = function
        self._result = result
        self._is_event = function.happens is not None
        names = ("at", "size") if self._is_event else function.parameters
        self._locals = {name: (index, parameters[index]) for index, name in enumerate(names)}
        self._parameters = len(parameters)
        self._depth = 0  # blocks that are open
        self._loops: list[int] = []  # at which depth the block of each loop is
        if self._is_event:
            self._local("dropped", _I32)
            self._local("changed", _I32)

    def code(self) -> bytes:
        """The body with its locals."""
        body = self._block(self._function.body) + _UNREACHABLE + _END
        made = sorted(self._locals.values())[self._parameters :]
        whole = _row([b"\x01" + bytes((machine,)) for _, machine in made]) + body
        return _unsigned(len(whole)) + whole

    # Parts

    def _local(self, name: str, machine: int) -> bytes:
        number, known = self._locals.setdefault(name, (len(self._locals), machine))
        if known != machine:
            raise NotScalarError(name)
        return _unsigned(number)

    def _get(self, name: str, machine: int = _I32) -> bytes:
        return b"\x20" + self._local(name, machine)

    def _set(self, name: str, machine: int = _I32) -> bytes:
        return b"\x21" + self._local(name, machine)

    def _if(self, test: bytes, yes: Callable[[], bytes], no: Callable[[], bytes] | None = None) -> bytes:
        self._depth += 1
        inner = yes() + (_ELSE + no() if no is not None else b"")
        self._depth -= 1
        return test + _IF + _NOTHING + inner + _END

    def _fault(self, reason: int, site: int) -> bytes:
        stores = b"".join(
            _constant(_I32, address) + _constant(_I32, value) + b"\x36\x00\x00"
            for address, value in ((0, site), (4, reason))
        )
        return stores + _UNREACHABLE

    # Statements

    def _block(self, statements: Sequence[form.Statement]) -> bytes:
        return b"".join(self._statement(statement) for statement in statements)

    def _statement(self, node: form.Statement) -> bytes:
        method = _STATEMENTS.get(type(node))
        if method is None:
            raise NotScalarError(type(node).__name__)
        return method(self, node)

    def _evaluate(self, node: form.Evaluate) -> bytes:
        value = node.value.value if isinstance(node.value, form.Discard) else node.value
        if isinstance(value, form.Assign):
            return self._assigned(value)
        if isinstance(value, form.Literal) and value.value is None:
            return b""
        return self._value(value) + _DROP

    def _either(self, node: form.If) -> bytes:
        no = (lambda: self._block(node.no)) if node.no else None
        return self._if(self._value(node.test), lambda: self._block(node.yes), no)

    def _loop(self, node: form.Loop) -> bytes:
        self._depth += 2
        self._loops.append(self._depth)
        body = self._block(node.body)
        self._loops.pop()
        self._depth -= 2
        return b"\x02\x40\x03\x40" + body + b"\x0c\x00" + _END + _END

    def _break(self, node: form.Break) -> bytes:
        del node
        return b"\x0c" + _unsigned(self._depth - self._loops[-1] + 1)

    def _continue(self, node: form.Continue) -> bytes:
        del node
        return b"\x0c" + _unsigned(self._depth - self._loops[-1])

    def _select(self, node: form.Select) -> bytes:
        machine = _wasm(node.value.type)
        value = f"{node.name} value"
        code = self._value(node.value) + self._set(value, machine) + _constant(_I32, node.default)
        code += self._set(node.name)
        for wanted, index in node.table:
            test = self._get(value, machine) + _constant(machine, wanted) + bytes((_COMPARE[machine]["=="],))
            chosen = _constant(_I32, index) + self._set(node.name)
            code += self._if(test, lambda chosen=chosen: chosen)  # type: ignore[misc]  # the row of this turn
        return code

    def _return(self, node: form.Return) -> bytes:
        if node.references:
            raise NotScalarError("references")
        if node.value.type == kinds.VOID:
            return _constant(_I32, 0) + _RETURN
        return self._value(node.value) + _RETURN

    def _leave(self, node: form.Leave) -> bytes:
        dropped = self._get("dropped") + _constant(_I32, 1) + b"\x74"
        changed = self._get("changed") + _constant(_I32, 2) + b"\x74"
        return _constant(_I32, bool(node.happened)) + dropped + b"\x72" + changed + b"\x72" + _RETURN

    def _charge(self, node: form.Charge) -> bytes:
        del node
        return b""

    def _drop(self, node: form.Drop) -> bytes:
        del node
        return _constant(_I32, 1) + self._set("dropped")

    def _require(self, node: form.Require) -> bytes:
        leave = form.Leave(node.site, False)
        return self._if(self._value(node.test) + b"\x45", lambda: self._leave(leave))

    def _read_numbers(self, node: form.ReadNumbers) -> bytes:
        end = max(offset + struct_size(struct_code(kind) or "") for _, kind, offset in node.fields)
        code = self._within(node.at, end, node.site)
        for name, kind, offset in node.fields:
            code += self._loaded(node.at.plus(offset), kind) + self._set(name, _wasm(kind))
        return code

    def _position(self, at: form.Spot) -> bytes:
        """A position, in 64 bits: the lengths in a message are not to be trusted."""
        offset = _constant(_I64, at.offset)
        return offset if at.base is None else self._get(at.base, _I64) + offset + b"\x7c"

    def _within(self, at: form.Spot, size: int, site: int) -> bytes:
        """A fault unless so many bytes of the message stand there."""
        short = self._get("size") + b"\xad" + self._position(at.plus(size)) + b"\x54"
        return self._if(short, lambda: self._fault(2, site))

    def _at(self, at: form.Spot, opcode: int) -> tuple[bytes, bytes]:
        """What stands before and in an access of the message at a position that is within it."""
        base = self._get("at") + (b"" if at.base is None else self._get(at.base, _I64) + b"\xa7\x6a")
        return base, bytes((opcode, 0)) + _unsigned(at.offset)

    def _loaded(self, at: form.Spot, kind: Type) -> bytes:
        codes = struct_code(kind) or ""
        if len(codes) == 2:
            extend = b"\xad" if codes[0] == "I" else b"\xac"
            seconds, rest = (b"".join(self._at(at.plus(more), 0x28)) + extend for more in (0, 4))
            return seconds + _constant(_I64, BILLION) + b"\x7e" + rest + b"\x7c"
        return b"".join(self._at(at, _LOAD[codes])) + (b"\x45\x45" if codes == "?" else b"")

    def _after_text(self, node: form.AfterText) -> bytes:
        length = b"".join(self._at(node.at, 0x28)) + b"\xad"
        end = self._position(node.at.plus(4)) + length + b"\x7c"
        return self._within(node.at, 4, node.site) + end + self._set(node.name, _I64)

    def _count(self, node: form.Count) -> bytes:
        """The number of elements, in 64 bits; a fault if so many are not there."""
        code = self._within(node.at, 4, node.site) + b"".join(self._at(node.at, 0x28)) + b"\xad"
        number = self._get(node.name, _I64)
        room = self._get("size") + b"\xad" + self._position(node.at.plus(4)) + b"\x7d"
        least = number + _constant(_I64, node.least) + b"\x7e"
        if not node.least:
            least, room = number, _constant(_I64, MAX_EMPTY)
        return (
            code
            + self._set(node.name, _I64)
            + self._if(least + room + b"\x56", lambda: self._fault(2, node.site))
        )

    def _after_elements(self, node: form.AfterElements) -> bytes:
        count = _constant(_I64, node.count) if isinstance(node.count, int) else self._get(node.count, _I64)
        end = self._position(node.at) + count + _constant(_I64, node.size) + b"\x7e\x7c"
        return end + self._set(node.name, _I64)

    def _write_back(self, node: form.WriteBack) -> bytes:
        code = self._if(self._get("dropped"), lambda: self._leave(form.Leave(node.site, True)))
        for write in node.writes:
            if write.end is not None:
                raise NotScalarError("a field of variable size")
            code += self._if(self._get(write.flag), lambda write=write: self._written(write))  # type: ignore[misc]
        return code

    def _written(self, write: form.Write) -> bytes:
        """Put a number where it differs, bit by bit."""
        codes = struct_code(write.value.type) or ""
        if len(codes) == 2:
            raise NotScalarError("a time that is assigned")
        machine, size = _wasm(write.value.type), struct_size(codes)
        whole = _I64 if size == 8 else _I32
        bits = {_F32: b"\xbc", _F64: b"\xbd"}.get(machine, b"")
        new = f"new {whole}"
        code = self._value(write.value) + bits + self._set(new, whole)
        load = {1: 0x2D, 2: 0x2F, 4: 0x28, 8: 0x29}[size]
        mask = _constant(_I32, (1 << 8 * size) - 1) + b"\x71" if size < 4 else b""
        differs = b"".join(self._at(write.at, load)) + self._get(new, whole) + mask
        differs += bytes((_COMPARE[whole]["!="],))

        def put() -> bytes:
            place, store = self._at(write.at, _STORE[size])
            return place + self._get(new, whole) + store + _constant(_I32, 1) + self._set("changed")

        return code + self._if(differs, put)

    # Expressions

    def _value(self, node: form.Expression) -> bytes:
        method = _EXPRESSIONS.get(type(node))
        if method is None:
            raise NotScalarError(type(node).__name__)
        return method(self, node)

    def _literal(self, node: form.Literal) -> bytes:
        if not isinstance(node.value, int | float):
            raise NotScalarError(repr(node.value))
        return _constant(_wasm(node.type), node.value)

    def _zero(self, node: form.Zero) -> bytes:
        return _constant(_wasm(node.type), 0)

    def _read(self, node: form.Read) -> bytes:
        machine = _wasm(node.type)
        if node.name not in self._writer.shared:
            return self._get(node.name, machine)
        load = {_I32: 0x28, _I64: 0x29, _F32: 0x2A, _F64: 0x2B}[machine]
        return _constant(_I32, 0) + bytes((load, 0)) + _unsigned(self._writer.address(node.name, node.type))

    def _assigned(self, node: form.Assign) -> bytes:
        machine, value = _wasm(node.type), self._value(node.value)
        if node.name not in self._writer.shared:
            return value + self._set(node.name, machine)
        store = {_I32: 0x36, _I64: 0x37, _F32: 0x38, _F64: 0x39}[machine]
        address = _unsigned(self._writer.address(node.name, node.type))
        return _constant(_I32, 0) + value + bytes((store, 0)) + address

    def _assign(self, node: form.Assign) -> bytes:
        return self._assigned(node) + self._read(form.Read(node.type, node.name))

    def _convert(self, node: form.Convert) -> bytes:
        code, source, target = self._value(node.value), node.value.type, node.type
        one, other = _wasm(source), _wasm(target)
        if isinstance(target, kinds.Bool):
            return code + _constant(one, 0) + bytes((_COMPARE[one]["!="],))
        if isinstance(target, kinds.Floating):
            return code + _to_floating(one, other, signed=_is_signed(source))
        assert isinstance(target, kinds.Integer)  # noqa: S101  numbers are one of the three
        if isinstance(source, kinds.Floating):
            return self._truncated(code + (b"\xbb" if one == _F32 else b""), target)
        if one == other:
            return code + _narrowed(target)
        if other == _I64:
            return code + (b"\xac" if _is_signed(source) else b"\xad")
        return code + b"\xa7" + _narrowed(target)

    def _truncated(self, code: bytes, target: kinds.Integer) -> bytes:
        """A double toward zero, at most the limits."""
        if target.bits >= 32:
            wide = 4 if target.bits == 64 else 0
            return code + b"\xfc" + bytes((2 + wide + (not target.signed),))
        code += b"\xfc\x02" + self._set("cut")
        for limit, operator in ((target.least, "<"), (target.most, ">")):
            limited, value = _constant(_I32, limit), self._get("cut")
            test = value + limited + bytes((_COMPARE[_I32][operator],))
            code += limited + value + test + _SELECT + self._set("cut")
        return code + self._get("cut")

    def _arithmetic(self, node: form.Arithmetic) -> bytes:
        machine, operator = _wasm(node.type), node.operator
        left, right = self._value(node.left), self._value(node.right)
        opcode = _CALCULATE[machine][operator]
        if machine in (_F32, _F64) or operator in "+-*&|^":
            return left + right + bytes((opcode,))
        unsigned = not _is_signed(node.type)
        if operator in ("<<", ">>"):
            if _wasm(node.right.type) != machine:
                right += b"\xa7" if machine == _I32 else b"\xad"
            return left + right + bytes((opcode + (unsigned and operator == ">>"),))
        return self._divided(node, left, right, bytes((opcode + unsigned,)))

    def _divided(self, node: form.Arithmetic, left: bytes, right: bytes, opcode: bytes) -> bytes:
        machine = _wasm(node.type)
        one, other = (f"{side} {machine} {node.site}" for side in ("dividend", "divisor"))
        code = left + self._set(one, machine) + right + self._set(other, machine)
        zero = self._get(other, machine) + (b"\x45" if machine == _I32 else b"\x50")
        code += self._if(zero, lambda: self._fault(1, node.site))
        quotient = self._get(one, machine) + self._get(other, machine) + opcode
        if node.operator == "%" or not _is_signed(node.type):
            return code + quotient
        minus = self._get(other, machine) + _constant(machine, -1) + bytes((_COMPARE[machine]["=="],))
        negated = _constant(machine, 0) + self._get(one, machine) + bytes((_CALCULATE[machine]["-"],))
        return code + minus + _IF + bytes((machine,)) + negated + _ELSE + quotient + _END

    def _unary(self, node: form.Unary) -> bytes:
        machine, value = _wasm(node.type), self._value(node.value)
        if machine in (_F32, _F64):
            return value + bytes(((_ABS if node.operator == "abs" else _NEG)[machine],))
        if node.operator == "~":
            return value + _constant(machine, -1) + bytes((_CALCULATE[machine]["^"],))
        kept = f"kept {machine}"
        code = value + self._set(kept, machine)
        negated = _constant(machine, 0) + self._get(kept, machine) + bytes((_CALCULATE[machine]["-"],))
        if node.operator == "-":
            return code + negated
        if not _is_signed(node.type):
            return code + self._get(kept, machine)
        negative = self._get(kept, machine) + _constant(machine, 0) + bytes((_COMPARE[machine]["<"],))
        return code + negated + self._get(kept, machine) + negative + _SELECT

    def _compare(self, node: form.Compare) -> bytes:
        machine = _wasm(node.left.type)
        opcode = _COMPARE[machine][node.operator]
        if node.operator not in ("==", "!=") and not _is_signed(node.left.type):
            opcode += 1
        return self._value(node.left) + self._value(node.right) + bytes((opcode,))

    def _logical(self, node: form.Logical) -> bytes:
        yes, no = self._nested(node.right), _constant(_I32, node.operator == "or")
        branches = (yes, no) if node.operator == "and" else (no, yes)
        return self._value(node.left) + _IF + bytes((_I32,)) + branches[0] + _ELSE + branches[1] + _END

    def _nested(self, node: form.Expression) -> bytes:
        self._depth += 1
        code = self._value(node)
        self._depth -= 1
        return code

    def _not(self, node: form.Not) -> bytes:
        return self._value(node.value) + b"\x45"

    def _conditional(self, node: form.Conditional) -> bytes:
        kind = bytes((_wasm(node.type),))
        yes, no = self._nested(node.yes), self._nested(node.no)
        return self._value(node.test) + _IF + kind + yes + _ELSE + no + _END

    def _sequence(self, node: form.Sequence) -> bytes:
        chosen = node.chosen % len(node.items)
        values = [
            self._value(item) + (b"" if index == chosen else _DROP) for index, item in enumerate(node.items)
        ]
        return b"".join(values)

    def _call(self, node: form.Call) -> bytes:
        """`std::min` and `std::max`: the second if it is less, or greater."""
        if node.function not in ("h_min", "h_max"):
            raise NotScalarError(node.function)
        machine = _wasm(node.type)
        one, other = (f"{side} {machine} {len(self._locals)}" for side in ("first", "second"))
        code = b"".join(
            self._value(argument) + self._set(name, machine)
            for name, argument in zip((one, other), node.arguments, strict=True)
        )
        opcode = _COMPARE[machine]["<" if node.function == "h_min" else ">"] + (not _is_signed(node.type))
        test = self._get(other, machine) + self._get(one, machine) + bytes((opcode,))
        return code + self._get(other, machine) + self._get(one, machine) + test + _SELECT

    def _invoke(self, node: form.Invoke) -> bytes:
        if node.depth is not None:
            raise NotScalarError("recursion")
        result = _I32 if node.type == kinds.VOID else _wasm(node.type)
        parameters = tuple(_wasm(argument.type) for argument in node.arguments)
        number = self._writer.index_of(node.function, parameters, result)
        return b"".join(map(self._value, node.arguments)) + b"\x10" + _unsigned(number)


def _to_floating(source: int, target: int, *, signed: bool) -> bytes:
    if source in (_F32, _F64):
        return b"" if source == target else b"\xb6" if target == _F32 else b"\xbb"
    first = 0xB2 if target == _F32 else 0xB7
    return bytes((first + 2 * (source == _I64) + (not signed),))


def _narrowed(target: kinds.Integer) -> bytes:
    """Wrap what stands in 32 bits into fewer."""
    if target.bits >= 32:
        return b""
    if target.signed:
        return b"\xc0" if target.bits == 8 else b"\xc1"
    return _constant(_I32, target.most) + b"\x71"


_STATEMENTS: Mapping[type[Any], Callable[[_Body, Any], bytes]] = MappingProxyType(
    {
        form.Evaluate: _Body._evaluate,
        form.If: _Body._either,
        form.Loop: _Body._loop,
        form.Break: _Body._break,
        form.Continue: _Body._continue,
        form.Select: _Body._select,
        form.Return: _Body._return,
        form.Leave: _Body._leave,
        form.Charge: _Body._charge,
        form.Drop: _Body._drop,
        form.Require: _Body._require,
        form.AfterText: _Body._after_text,
        form.Count: _Body._count,
        form.AfterElements: _Body._after_elements,
        form.ReadNumbers: _Body._read_numbers,
        form.WriteBack: _Body._write_back,
    }
)

_EXPRESSIONS: Mapping[type[Any], Callable[[_Body, Any], bytes]] = MappingProxyType(
    {
        form.Literal: _Body._literal,
        form.Zero: _Body._zero,
        form.Read: _Body._read,
        form.Assign: _Body._assign,
        form.Convert: _Body._convert,
        form.Arithmetic: _Body._arithmetic,
        form.Unary: _Body._unary,
        form.Compare: _Body._compare,
        form.Logical: _Body._logical,
        form.Not: _Body._not,
        form.Conditional: _Body._conditional,
        form.Sequence: _Body._sequence,
        form.Call: _Body._call,
        form.Invoke: _Body._invoke,
    }
)
