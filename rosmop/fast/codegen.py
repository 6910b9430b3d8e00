"""Translate functions of the intermediate form (`form/nodes.py`) to WebAssembly.

- The function of an event or handler takes the address of the message and its size (i32, i32), and returns flags
  (i32), such as `CHANGED` (bytes of the message), `RESET` (the handler restarts the property) and `REPLACED` (by the
  safe message).
- `ELSEWHERE` is returned at each fault and at each node that is not compiled: the interpreter must process the
  message, whose effects are undone. Functions that events and handlers call trap instead. An event is not compiled at
  all if every message would reach such a node.
- Before a field is written, the old bytes are appended to a log, whose end is at `UNDO`. An entry takes 16 bytes:
  address (i32), size (i32) and the old bytes (i64).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import inf
from types import MappingProxyType
from typing import Any

from rosmop.fast.abi import NOW, POSITION, SAID, UNDO, Cells, is_kept, is_texts
from rosmop.fast.arithmetic import in_seconds, to_floating
from rosmop.fast.codegen_access import load_code, root_of
from rosmop.fast.deferred_output import BYTES, HEAD, OutputLine, is_text
from rosmop.fast.memory_layout import LINES, MemoryLayout, NotCompiledError, is_signed, machine_type
from rosmop.fast.strings_codegen import StringCodegen, moved_texts, settling
from rosmop.fast.wasm import (
    DROP,
    F32,
    F32_ABS,
    F32_CEIL,
    F32_COPYSIGN,
    F32_FLOOR,
    F32_NEAREST,
    F32_SQRT,
    F32_TRUNC,
    F64,
    F64_ABS,
    F64_ADD,
    F64_CEIL,
    F64_CONVERT_I64_S,
    F64_COPYSIGN,
    F64_FLOOR,
    F64_MUL,
    F64_NEAREST,
    F64_PROMOTE_F32,
    F64_SQRT,
    F64_TRUNC,
    I32,
    I32_ADD,
    I32_AND,
    I32_EQZ,
    I32_GT_U,
    I32_MUL,
    I32_OR,
    I32_REINTERPRET_F32,
    I32_SHL,
    I32_WRAP_I64,
    I64,
    I64_ADD,
    I64_DIV_U,
    I64_EQZ,
    I64_EXTEND_I32_S,
    I64_EXTEND_I32_U,
    I64_GT_U,
    I64_LE_S,
    I64_LT_S,
    I64_OR,
    I64_REINTERPRET_F64,
    I64_SHL,
    I64_SHR_U,
    I64_SUB,
    I64_TRUNC_SAT_F64_S,
    RETURN,
    SELECT,
    UNREACHABLE,
    br,
    call,
    compare,
    constant,
    f64_store,
    function,
    i32_load,
    i32_load8_u,
    i32_load16_u,
    i32_store,
    i32_store8,
    i32_store16,
    i64_load,
    i64_store,
    load,
    store,
)
from rosmop.form import nodes
from rosmop.runtime import safe_messages
from rosmop.runtime.values import ValueCodec, struct_code, struct_size
from rosmop.runtime.wire import FEW
from rosmop.types import value_types
from rosmop.types.value_types import Type

_MOVES = {
    8: (i64_load, i64_store), 4: (i32_load, i32_store), 2: (i32_load16_u, i32_store16), 1: (i32_load8_u, i32_store8),
}  # fmt: skip

HAPPENED, DROPPED, CHANGED, RESET, REPLACED = 1, 2, 4, 16, 32

EARLY = 16

MAX_SAFE = 1024


@dataclass
class MessageEffects:
    """The possible effects of a function; `writes` counts the places that write to the message."""

    writes: int = 0
    drops: bool = False
    says: bool = False
    """Whether it may print lines."""
    early: bool = False
    """Whether it may write to the first bytes of the message, where a header is."""
    changes_elements: bool = False
    replaces: bool = False


@dataclass(frozen=True)
class WasmFunction:
    number: int
    parameters: tuple[int, ...]
    result: int
    code: bytes
    assigned: frozenset[str]
    effects: MessageEffects = field(hash=False)
    brief: bool
    """Whether it has no loops."""
    passes: bool
    """Whether conditions may end it early for some messages."""
    references: tuple[tuple[str, int], ...] = ()
    """Each reference parameter, with the address where the function stores its value before it returns."""
    names: tuple[str, ...] = ()
    """The names of the local variables, by number."""


class ModuleCodegen(MemoryLayout):
    """Writes the functions of a module, and lays out its memory."""

    def __init__(
        self, functions: Mapping[str, nodes.Function], shared: Mapping[str, Cells], values: ValueCodec
    ) -> None:
        super().__init__(functions, shared, values)
        self.written: list[WasmFunction] = []
        self._numbers: dict[tuple[object, ...], WasmFunction] = {}
        self.left: dict[str, list[NotCompiledError]] = {}

    def leave(self, function: str, error: NotCompiledError) -> None:
        self.left.setdefault(function, []).append(error)

    def event(self, name: str, channel: str = "") -> WasmFunction:
        function = self.functions[name]
        return self.function(function, {"at": I32, "size": I32}, I32, function.context, channel=channel)

    def stops(self, event: nodes.Event) -> bool:
        return any(
            isinstance(one, nodes.StopMessage) for one in nodes.walk(self.functions[event.function].body)
        )

    def function(
        self,
        function: nodes.Function | nodes.Skipper,
        parameters: Mapping[str, int],
        result: int,
        context: str,
        *,
        channel: str = "",
    ) -> WasmFunction:
        key = (function.name, tuple(parameters), result, context, channel)
        if key not in self._numbers:
            written = _FunctionCodegen(self, function, parameters, result, context, channel=channel).write()
            self._numbers[key] = written
            self.written.append(written)
        return self._numbers[key]

    def routine(
        self, key: tuple[object, ...], parameters: tuple[int, ...], write: Callable[[], bytes], result: int
    ) -> int:
        if key not in self._numbers:
            self._numbers[key] = self._add(parameters, write(), result)
        return self._numbers[key].number

    def routine_of(self, write: Callable[..., bytes]) -> int | None:
        written = self._numbers.get((write,))
        return None if written is None else written.number

    def settling(self, cells: Cells) -> int:
        copy_texts = b""
        if any(is_texts(kind) for _, kind in cells.variables.values()):
            copy_texts = call(self.routine((moved_texts,), (I32, I32, I32), moved_texts, I32))
        cells.settle = self._add((), settling(self, cells, copy_texts)).number
        return cells.settle

    def _add(self, parameters: tuple[int, ...], code: bytes, result: int = I32) -> WasmFunction:
        written = WasmFunction(
            len(self.written), parameters, result, code, frozenset(), MessageEffects(), brief=True, passes=True,
        )  # fmt: skip
        self.written.append(written)
        return written


class _FunctionCodegen(StringCodegen):
    def __init__(
        self,
        writer: ModuleCodegen,
        function: nodes.Function | nodes.Skipper,
        parameters: Mapping[str, int],
        result: int,
        context: str,
        *,
        channel: str,
    ) -> None:
        answers = isinstance(function, nodes.Function) and function.parameters == ("m",)
        super().__init__(writer, parameters, context, answers=answers)
        self._writer = writer
        self._function = function
        self._references: dict[str, int] = {}
        self._result = result
        self._is_handler = answers and function.happens is None  # type: ignore[union-attr]  # was checked
        self._types = tuple(parameters.values())
        self._depends = False  # whether messages may be left before this place
        self._effects = MessageEffects()
        self._channel = channel
        self._safe: nodes.SafeMessage | None = None
        self._bits: tuple[tuple[str, int], ...] = ()
        if answers:
            self._bits = (("dropped", 1), ("changed", 2), *([("reset", 4)] if self._is_handler else ()))
            if any(isinstance(node, nodes.StopMessage) for node in nodes.walk(function.body)):
                self._bits += (("replaced", 5),)
        for name, _ in self._bits:
            self._local(name, I32)

    def write(self) -> WasmFunction:
        body = self._block(self._function.body)
        if isinstance(self._function, nodes.Skipper):
            body += self._position(self._function.end) + RETURN
        if self._is_handler:
            body += self._leave(nodes.Leave(-1, None))
        made = sorted(self._locals.values())[len(self._types) :]
        return WasmFunction(
            len(self._writer.written),
            self._types,
            self._result,
            function([(1, machine) for _, machine in made], body + UNREACHABLE),
            frozenset(self._assigned.intersection(self._writer.shared)),
            replace(self._effects, replaces=self._safe is not None),
            self._brief,
            self._depends,
            tuple(self._references.items()),
            tuple(self._locals),
        )

    def _routine(
        self, parameters: tuple[int, ...], write: Callable[..., bytes], *given: object, result: int = I32
    ) -> bytes:
        number = self._writer.routine((write, *given), parameters, partial(write, *given), result)
        return call(number)

    # Statements

    def _block(self, statements: Sequence[nodes.Statement]) -> bytes:
        return b"".join(self._statement(statement) for statement in statements)

    def _statement(self, node: nodes.Statement) -> bytes:
        depth, loops = self._depth, len(self._loops)
        try:
            row = STATEMENTS[type(node)]
            if isinstance(row, nodes.Left):
                raise NotCompiledError(row.reason)
            return row(self, node)
        except NotCompiledError as error:
            error.place(node.site)
            if not depth and not self._depends:
                raise
            self._writer.leave(self._function.name, error)
            self._depth = depth
            del self._loops[loops:]
            return self._elsewhere()

    def _evaluate(self, node: nodes.Evaluate) -> bytes:
        value = node.value.value if isinstance(node.value, nodes.Discard) else node.value
        if isinstance(value, nodes.Assign):
            return self._assigned_to(value)
        if isinstance(value, nodes.Literal) and value.value is None:
            return b""
        if isinstance(value, nodes.Sequence):
            return b"".join(self._evaluate(nodes.Evaluate(node.site, item)) for item in value.items)
        if isinstance(value, nodes.Conditional) and value.type == value_types.VOID:
            yes, no = ((nodes.Evaluate(node.site, branch),) for branch in (value.yes, value.no))
            return self._if(nodes.If(node.site, value.test, yes, no))
        return self._value(value) + DROP

    def _if(self, node: nodes.If) -> bytes:
        test = self._value(node.test)
        self._depends = True
        no = (lambda: self._block(node.no)) if node.no else None
        return self._when(test, lambda: self._block(node.yes), no)

    def _loop(self, node: nodes.Loop) -> bytes:
        self._brief = False
        return self._repeat(b"", node.body)

    def _for_each(self, node: nodes.ForEach) -> bytes:
        kind, size = self._writer.element(node.values.type)
        first, place, count = self._elements(node.values)
        self._brief = False
        at, left = (f"{what} {len(self._locals)}" for what in ("element", "left"))
        if isinstance(kind, value_types.StringType):
            each, begin, length = self._text_at(self._get(at))
            each += begin + self._set(f"place of {node.name}") + length
            each += self._set(f"count of {node.name}", I64)
        elif isinstance(kind, value_types.RecordType):
            each = self._get(at) + self._set(f"place of {node.name}")
        else:
            each = load_code(self._get(at), 0, kind) + self._set(node.name, machine_type(kind))
        following = self._get(at) + constant(I32, size) + I32_ADD + self._set(at)
        code = first + place + self._set(at) + count + self._set(left, I64)
        with self._apart(node.values):
            return code + self._times(left, each + following, node.body)

    def _break(self, _node: nodes.Break) -> bytes:
        return br(self._depth - self._loops[-1] + 1)

    def _continue(self, _node: nodes.Continue) -> bytes:
        return br(self._depth - self._loops[-1])

    def _select(self, node: nodes.Select) -> bytes:
        machine = machine_type(node.value.type)
        value = f"{node.name} value"
        code = self._value(node.value) + self._set(value, machine) + constant(I32, node.default)
        code += self._set(node.name)
        for wanted, index in node.table:
            test = self._get(value, machine) + constant(machine, wanted) + compare(machine, "==")
            chosen = constant(I32, index) + self._set(node.name)
            code += self._when(test, lambda chosen=chosen: chosen)  # type: ignore[misc]  # the row of this iteration
        return code

    def _leave(self, node: nodes.Leave) -> bytes:
        code = constant(I32, bool(node.happened))
        for name, shift in self._bits:
            code += self._get(name) + constant(I32, shift) + I32_SHL + I32_OR
        return code + RETURN

    def _charge(self, node: nodes.Charge) -> bytes:
        return self._spend(constant(I64, node.instructions))

    def _allocate(self, node: nodes.Allocate) -> bytes:
        if node.size is not None:
            return self._allocated(constant(I64, node.size))
        many = self._length() + constant(I64, nodes.CHARGED) + I64_GT_U
        return self._when(many, lambda: self._allocated(self._length()))

    def _pending(self, _node: nodes.Pending) -> bytes:
        """Only `Whole` uses the list of fields, and `Whole` is not compiled."""
        return b""

    def _drop(self, _node: nodes.Drop) -> bytes:
        self._effects.drops = True
        return constant(I32, 1) + self._set("dropped")

    def _stop(self, node: nodes.StopMessage) -> bytes:
        safe = next((one for one in node.safes if one.topic == self._channel), None)
        if safe is None:
            raise NotCompiledError("publishes safe messages")
        if len(safe.data) > MAX_SAFE:
            raise NotCompiledError(f"sends a safe message of more than {MAX_SAFE} bytes")
        self._safe, self._depends = safe, True
        differs = self._length() + constant(I64, len(safe.data)) + compare(I64, "!=")
        return self._when(differs, self._elsewhere) + constant(I32, 1) + self._set("replaced")

    def _put_safe(self, safe: nodes.SafeMessage, site: int) -> bytes:
        code, offset = b"", safe_messages.HEAD if safe.stamped else 0
        self._effects.early = self._effects.early or offset < EARLY
        while offset < len(safe.data):
            size = next(size for size in _MOVES if offset + size <= len(safe.data))
            number = int.from_bytes(safe.data[offset : offset + size], "little")
            self._effects.writes += 1
            code += self._put_bits(self._get("at"), offset, size, constant(I64 if size == 8 else I32, number))
            offset += size
        return code + self._leave(nodes.Leave(site, True))

    def _reset(self, _node: nodes.Reset) -> bytes:
        return constant(I32, 1) + self._set("reset")

    def _require(self, node: nodes.Require) -> bytes:
        test, leave = self._value(node.test) + I32_EQZ, nodes.Leave(node.site, False)
        self._depends = True
        return self._when(test, lambda: self._leave(leave))

    def _not_past(self, node: nodes.NotPast) -> bytes:
        past = self._get(node.count, I64) + constant(I64, node.index) + I64_LE_S
        self._depends = True
        return self._when(past, self._elsewhere)

    def _skip(self, node: nodes.Skip) -> bytes:
        count = constant(I64, node.count) if isinstance(node.count, int) else self._get(node.count, I64)
        left, place = (f"{what} {len(self._locals)}" for what in ("left", "place"))
        code = count + self._set(left, I64) + self._position(node.at) + self._set(place, I64)
        if node.inner:
            code += self._spend(self._get(left, I64) + constant(I64, 1) + I64_ADD)
        else:
            many = self._get(left, I64) + constant(I64, FEW) + I64_GT_U
            code += self._when(many, lambda: self._spend(self._get(left, I64)))
        if node.skipper is None:
            end = self._after_text(nodes.AfterText(node.site, place, nodes.Spot(place, 0)))
        else:
            given = {"at": I32, "size": I32, "p": I64}
            skipper = self._writer.function(node.skipper, given, I64, self._context)
            end = self._get("at") + self._get("size") + self._get(place, I64)
            end += call(skipper.number) + self._set(place, I64)
        code += self._times(left, end)
        return code + self._get(place, I64) + self._set(node.name, I64)

    def _write_back(self, node: nodes.WriteBack) -> bytes:
        code = self._when(self._get("dropped"), lambda: self._leave(nodes.Leave(node.site, True)))
        if (safe := self._safe) is not None:
            code += self._when(self._get("replaced"), lambda: self._put_safe(safe, node.site))
        for write in sorted(node.writes, key=lambda write: write.end is not None):
            self._effects.early = self._effects.early or (write.at.base is None and write.at.offset < EARLY)
            self._effects.changes_elements = self._effects.changes_elements or any(
                isinstance(part, int) for part in write.path[1:]
            )
            code += self._when(self._get(write.flag), partial(self._put_field, write, node.site))
        return code

    def _put_field(self, write: nodes.Write, site: int) -> bytes:
        try:
            return self._put_number(write)
        except NotCompiledError as error:
            error.place(site)
            self._writer.leave(self._function.name, error)
            return self._elsewhere()

    def _put_number(self, write: nodes.Write) -> bytes:
        if write.end is not None:
            raise NotCompiledError.of(write.value.type)
        codes = struct_code(write.value.type) or ""
        machine, size = machine_type(write.value.type), struct_size(codes)
        value = self._value(write.value)
        code = b""
        if machine in (F32, F64):
            kept = f"kept {machine}"
            none = self._get(kept, machine) + self._get(kept, machine) + compare(machine, "!=")
            code = value + self._set(kept, machine) + self._when(none, self._elsewhere)
            value = self._get(kept, machine) + (
                I32_REINTERPRET_F32 if machine == F32 else I64_REINTERPRET_F64
            )
        elif len(codes) == 2:
            code, value = self._parts_of(write.value.type, value)
        self._effects.writes += 1
        base = b"" if write.at.base is None else self._get(write.at.base, I64) + I32_WRAP_I64 + I32_ADD
        return code + self._put_bits(self._get("at") + base, write.at.offset, size, value)

    def _put_bits(self, place: bytes, offset: int, size: int, bits: bytes) -> bytes:
        whole = I64 if size == 8 else I32
        get, overwrite = (instruction(offset) for instruction in _MOVES[size])
        new, mask = f"new {whole}", constant(I32, (1 << 8 * size) - 1) + I32_AND if size < 4 else b""
        old = place + get
        differs = old + self._get(new, whole) + mask + compare(whole, "!=")

        def put() -> bytes:
            entry, end = self._get("entry"), load(I32, UNDO) + self._set("entry")
            note = entry + place + constant(I32, offset) + I32_ADD + i32_store(0)
            note += entry + constant(I32, size) + i32_store(4)
            note += entry + old + (b"" if whole == I64 else I64_EXTEND_I32_U) + i64_store(8)
            note += store(I32, UNDO, entry + constant(I32, 16) + I32_ADD)
            code = end + note + place + self._get(new, whole) + overwrite
            return code + constant(I32, 1) + self._set("changed")

        return bits + self._set(new, whole) + self._when(differs, put)

    # Expressions

    def _value(self, node: nodes.Expression) -> bytes:
        row = EXPRESSIONS[type(node)]
        if isinstance(row, nodes.Left):
            raise NotCompiledError(row.reason)
        return row(self, node)

    def _read(self, node: nodes.Read) -> bytes:
        machine = machine_type(node.type)
        cells = self._writer.shared.get(node.name)
        if cells is None:
            return self._get(node.name, machine)
        return load(machine, self._writer.variable(node.name, node.type))

    def _assigned_to(self, node: nodes.Assign) -> bytes:
        if isinstance(node.type, value_types.StringType) or (
            node.name in self._writer.shared and is_kept(node.type)
        ):
            return self._assigned_text(node)
        if isinstance(node.type, value_types.VectorType | value_types.RecordType):
            return self._named_in_place(node)
        if node.type == value_types.VOID:
            return self._handed(node.name, node.value)
        machine, value = machine_type(node.type), self._value(node.value)
        cells = self._writer.shared.get(node.name)
        if cells is None:
            return value + self._set(node.name, machine)
        self._assigned.add(node.name)
        return store(machine, self._writer.variable(node.name, node.type), value)

    def _named_in_place(self, node: nodes.Assign) -> bytes:
        source, shared = root_of(node.value), self._writer.shared
        if not source or source in shared or node.name in shared:
            raise NotCompiledError.of(node.type)
        self._assigned.add(node.name)
        if isinstance(node.type, value_types.RecordType):
            return b"".join(self._place(node.value)) + self._set(f"place of {node.name}")
        code, place, count = self._elements(node.value)
        code += place + self._set(f"place of {node.name}")
        return code + count + self._set(f"count of {node.name}", I64)

    def _assign(self, node: nodes.Assign) -> bytes:
        return self._assigned_to(node) + self._read(nodes.Read(node.type, node.name))

    def _log(self, node: nodes.Log) -> bytes:
        line, number = OutputLine(self._context, node), len(self._locals)
        code, cost, stores = b"", constant(I64, line.cost), b""
        for place, value in enumerate(line.values):
            first, slot, size = self._slot(value, f"value {place} {number}", HEAD.size + 8 * place)
            code, stores, cost = code + first, stores + slot, cost + size
        self._effects.says = True
        return code + self._noted_line(line, cost) + stores + constant(I32, 0)

    def _noted_line(self, line: OutputLine, cost: bytes) -> bytes:
        known = self._layout.lines
        code = load(I32, SAID) + self._set("line")
        end = self._get("line") + constant(I32, line.size) + I32_ADD
        full = end + constant(I32, self._layout.said + LINES) + I32_GT_U
        code += self._when(full, self._elsewhere) + self._spend(cost) + store(I32, SAID, end)
        for offset, head in ((0, constant(I32, len(known))), (4, load(I32, POSITION))):
            code += self._get("line") + head + i32_store(offset)
        known.append(line)
        return code

    def _slot(self, node: nodes.Expression, name: str, at: int) -> tuple[bytes, bytes, bytes]:
        line = self._get("line")
        if is_text(node):
            first, place, count = self._elements(node)
            first += place + self._set(name) + count + self._set(f"count of {name}", I64)
            length = self._get(f"count of {name}", I64)
            put = line + self._get(name) + i32_store(at)
            put += line + length + I32_WRAP_I64 + i32_store(at + 4)
            return first, put, length + constant(I64, BYTES) + I64_DIV_U + I64_ADD
        machine = machine_type(node.type)
        first, value = self._value(node) + self._set(name, machine), self._get(name, machine)
        if machine in (F32, F64):
            value += F64_PROMOTE_F32 if machine == F32 else b""
            return first, line + value + f64_store(at), b""
        wide = (I64_EXTEND_I32_S if is_signed(node.type) else I64_EXTEND_I32_U) if machine == I32 else b""
        return first, line + value + wide + i64_store(at), b""

    def _throttle(self, node: nodes.Throttle) -> bytes:
        seconds = self._value(node.seconds) + to_floating(
            machine_type(node.seconds.type), F64, signed=is_signed(node.seconds.type)
        )
        last, now = load(I64, self._writer.throttle(self._context, node.site)), load(I64, NOW)
        until = last + F64_CONVERT_I64_S + seconds + constant(F64, 1e9) + F64_MUL + F64_ADD
        until += F64_CEIL + I64_TRUNC_SAT_F64_S
        waits = last + now + I64_LE_S + now + until + I64_LT_S + I32_AND
        return self._when(waits + I32_EQZ, self._elsewhere) + constant(I32, 0)

    def _accumulate(self, node: nodes.Accumulate) -> bytes:
        kind, size = self._writer.element(node.vector.type)
        code, place, count = self._elements(node.vector)
        number = len(self._locals)
        total, each = (f"{what} {number}" for what in ("sum", "summand"))
        at, left, last = (f"{what} {number}" for what in ("element", "left", "last"))
        with self._apart(node.vector):
            code += self._value(node.start) + self._set(total, machine_type(node.type))
            code += self._value(node.first) + self._set(left, I64)
            code += self._value(node.last) + self._set(last, I64)
        outside = self._get(left, I64) + self._get(last, I64) + I64_GT_U + self._get(last, I64) + count
        code += self._when(outside + I64_GT_U + I32_OR, self._elsewhere)
        code += place + self._get(left, I64) + I32_WRAP_I64 + constant(I32, size) + I32_MUL + I32_ADD
        code += self._set(at)
        code += self._get(last, I64) + self._get(left, I64) + I64_SUB + self._set(left, I64)
        code += self._spend(self._get(left, I64))
        one, other = (
            nodes.Convert(node.wide, nodes.Read(*part)) for part in ((node.type, total), (kind, each))
        )
        added = nodes.Convert(node.type, nodes.Arithmetic(node.wide, "+", one, other, node.site))
        span = nodes.Assign(node.type, total, added)
        summed = load_code(self._get(at), 0, kind) + self._set(each, machine_type(kind))
        summed += self._evaluate(nodes.Evaluate(node.site, span))
        summed += self._get(at) + constant(I32, size) + I32_ADD + self._set(at)
        self._brief = False
        code += self._times(left, summed)
        return code + self._get(total, machine_type(node.type))

    def _nearest(self, node: nodes.Call) -> bytes:
        vector, number = node.arguments[0], len(self._locals)
        first, last, least = (f"{what} {number}" for what in ("first", "last", "least"))
        code, place, count = self._elements(vector)
        with self._apart(vector):
            for name, limit in zip((first, last), node.arguments[1:], strict=True):
                code += self._value(limit) + self._set(name, I64)
        for name in (first, last):
            value = self._get(name, I64)
            code += value + constant(I64, 0) + value + constant(I64, 0) + compare(I64, ">") + SELECT
            code += self._set(name, I64)
            code += value + count + value + count + compare(I64, "<") + SELECT + self._set(name, I64)
        code += constant(F64, inf) + self._set(least, F64)
        begin, end, zero = self._get(first, I64), self._get(last, I64), constant(I64, 0)
        wraps = begin + end + compare(I64, ">")
        straight = self._scan(vector, place, (begin, end), least)
        around = self._scan(vector, place, (begin, count), least)
        around += self._scan(vector, place, (zero, end), least)
        return code + self._when(wraps, lambda: around, lambda: straight) + self._get(least, F64)

    def _scan(self, vector: nodes.Expression, place: bytes, limits: tuple[bytes, bytes], least: str) -> bytes:
        kind, size = self._writer.element(vector.type)
        at, left, each = (f"{what} {len(self._locals)}" for what in ("element", "left", "each"))
        code = place + limits[0] + I32_WRAP_I64 + constant(I32, size) + I32_MUL + I32_ADD + self._set(at)
        code += limits[1] + limits[0] + I64_SUB + self._set(left, I64) + self._spend(self._get(left, I64))
        value = load_code(self._get(at), 0, kind)
        value += to_floating(machine_type(kind), F64, signed=is_signed(kind)) + self._set(each, F64)
        value += self._get(each, F64) + self._get(least, F64) + self._get(each, F64) + self._get(least, F64)
        value += compare(F64, "<") + SELECT + self._set(least, F64)
        value += self._get(at) + constant(I32, size) + I32_ADD + self._set(at)
        self._brief = False
        return code + self._times(left, value)

    def _call(self, node: nodes.Call) -> bytes:
        special = _SPECIAL.get(node.function)
        if special is not None:
            return special(self, node)
        argument = node.arguments[0]
        if node.function in _OF_COUNTS:
            first, _, count = self._elements(argument)
            return first + count + _OF_COUNTS[node.function]
        if node.function in _QUESTIONS:
            return self._question(argument, _QUESTIONS[node.function])
        if (
            isinstance(node.type, value_types.IteratorType)
            and isinstance(argument, nodes.Call)
            and argument.function != "l_len"
        ):
            raise NotCompiledError("adds more than two numbers that must not wrap")
        opcode = _OPCODES.get((node.function, machine_type(argument.type)))
        if opcode is not None:
            return b"".join(map(self._value, node.arguments)) + opcode
        if node.function not in _OF_MOMENTS:
            raise NotCompiledError(f"calls {node.function.partition('_')[2]}")
        code = self._value(argument) + _OF_MOMENTS[node.function](self)
        return code + I32_WRAP_I64 if machine_type(node.type) == I32 else code

    def _sequence(self, node: nodes.Sequence) -> bytes:
        chosen = node.chosen % len(node.items)
        return b"".join(
            self._value(item) if index == chosen else self._evaluate(nodes.Evaluate(-1, item))
            for index, item in enumerate(node.items)
        )

    def _after(self, node: nodes.Sequence) -> tuple[bytes, bytes, bytes]:
        *before, last = node.items
        if node.chosen not in (-1, len(before)):
            raise NotCompiledError.of(node.type)
        code = b"".join(self._evaluate(nodes.Evaluate(-1, item)) for item in before)
        first, place, count = self._elements(last)
        return code + first, place, count

    # Arguments and results of functions

    def _invoke(self, node: nodes.Invoke) -> bytes:
        return self._called(node)[0]

    def _called(self, node: nodes.Invoke) -> tuple[bytes, tuple[tuple[str, int], ...]]:
        """Return the code, and the address of each reference's value after the call.

        A string or vector is returned as address (32 bits) and length.
        """
        if node.depth is not None:
            raise NotCompiledError("calls a recursive function")
        result = (
            I32
            if node.type == value_types.VOID
            else I64
            if _has_place(node.type)
            else machine_type(node.type)
        )
        function = self._writer.functions[node.function]
        parameters: dict[str, int] = {}
        code = b""
        with self._apart(*node.arguments):
            for name, argument in zip(function.parameters, node.arguments, strict=True):
                if _has_place(argument.type):
                    self._keep_name(argument)
                    parameters |= {f"place of {name}": I32, f"count of {name}": I64}
                    code += b"".join(self._elements(argument))
                elif isinstance(argument.type, value_types.RecordType):
                    parameters[f"place of {name}"] = I32
                    code += b"".join(self._place(argument))
                else:
                    parameters[name] = machine_type(argument.type)
                    code += self._value(argument)
            called = self._writer.function(function, parameters, result, function.context)
            self._assigned |= called.assigned
        self._brief = self._brief and called.brief
        self._effects.says = self._effects.says or called.effects.says
        return code + call(called.number), called.references

    def _return(self, node: nodes.Return) -> bytes:
        kind, code, answer = node.value.type, b"", constant(I32, 0)
        if _has_place(kind):
            self._keep_name(node.value)
            code, place, count = self._noted(b"".join(self._elements(node.value)))
            answer = place + I64_EXTEND_I32_U + count + constant(I64, 32) + I64_SHL + I64_OR
        elif kind != value_types.VOID:
            name = f"answer {machine_type(kind)}"
            code, answer = (
                self._value(node.value) + self._set(name, machine_type(kind)),
                self._get(name, machine_type(kind)),
            )
        for name in node.references:
            at = self._references.setdefault(name, self._writer.reference())
            if f"count of {name}" in self._locals:
                code += store(I32, at, self._get(f"place of {name}"))
                code += store(I32, at + 4, self._get(f"count of {name}", I64) + I32_WRAP_I64)
            elif name in self._locals:
                machine = self._locals[name][1]
                code += store(machine, at, self._get(name, machine))
            else:
                raise NotCompiledError("passes a message by reference")
        return code + answer + RETURN

    def _handed(self, name: str, node: nodes.Expression) -> bytes:
        if not isinstance(node, nodes.Invoke):
            raise NotCompiledError.of(node.type)
        code, references = self._called(node)
        if _has_place(node.type):
            code += self._put_span(f"{name} 0")
        else:
            code += DROP if node.type == value_types.VOID else self._set(f"{name} 0", machine_type(node.type))
        kinds_of = dict(zip(self._writer.functions[node.function].parameters, node.arguments, strict=True))
        for number, (reference, at) in enumerate(references, 1):
            kind = kinds_of[reference].type
            if _has_place(kind):
                code += load(I64, at) + self._put_span(f"{name} {number}")
            else:
                machine = machine_type(kind)
                code += load(machine, at) + self._set(f"{name} {number}", machine)
        return code

    def _put_span(self, name: str) -> bytes:
        code = self._set("span", I64) + self._get("span", I64) + I32_WRAP_I64 + self._set(f"place of {name}")
        return (
            code + self._get("span", I64) + constant(I64, 32) + I64_SHR_U + self._set(f"count of {name}", I64)
        )

    def _handed_back(self, node: nodes.Invoke) -> tuple[bytes, bytes, bytes]:
        name = f"handed back {len(self._locals)}"
        code = self._invoke(node) + self._put_span(name)
        return code, self._get(f"place of {name}"), self._get(f"count of {name}", I64)

    def _elements(self, node: nodes.Expression) -> tuple[bytes, bytes, bytes]:
        if isinstance(node, nodes.Item) and node.base.type == value_types.VOID:
            return super()._elements(_part_of(node))
        if _has_place(node.type) and isinstance(node, nodes.Invoke):
            return self._handed_back(node)
        if _has_place(node.type) and isinstance(node, nodes.Sequence):
            return self._after(node)
        return super()._elements(node)

    def _item(self, node: nodes.Item) -> bytes:
        if node.base.type != value_types.VOID:
            return super()._item(node)
        return constant(I32, 0) if node.type == value_types.VOID else self._value(_part_of(node))


def _has_place(kind: Type) -> bool:
    return isinstance(kind, value_types.StringType | value_types.VectorType)


def _part_of(node: nodes.Item) -> nodes.Read:
    assert isinstance(node.base, nodes.Read)  # noqa: S101  the form guarantees this
    return nodes.Read(node.type, f"{node.base.name} {node.number}")


_EXACT = {
    "fabs": (F32_ABS, F64_ABS), "ceil": (F32_CEIL, F64_CEIL), "floor": (F32_FLOOR, F64_FLOOR),
    "trunc": (F32_TRUNC, F64_TRUNC), "rint": (F32_NEAREST, F64_NEAREST), "nearbyint": (F32_NEAREST, F64_NEAREST),
    "sqrt": (F32_SQRT, F64_SQRT), "copysign": (F32_COPYSIGN, F64_COPYSIGN),
}  # fmt: skip
_OPCODES = {
    **{(f"h_{name}", F64): double for name, (_, double) in _EXACT.items()},
    **{(f"h_{name}f", F32): single for name, (single, _) in _EXACT.items()},
    ("m_is_zero", I64): I64_EQZ,
    ("m_whole", I64): b"",
    ("k_after", I64): I64_ADD,
    ("k_before", I64): I64_SUB,
}
_SPECIAL: Mapping[str, Callable[[_FunctionCodegen, nodes.Call], bytes]] = MappingProxyType(
    {
        **dict.fromkeys(
            ("h_min", "h_max", "h_fmin", "h_fmax", "h_fminf", "h_fmaxf"), _FunctionCodegen._least
        ),
        "a_part": _FunctionCodegen._with_part,
        "a_put": _FunctionCodegen._put,
        "l_clear": _FunctionCodegen._cleared,
        "l_element": _FunctionCodegen._element_at,
        "l_nearest": _FunctionCodegen._nearest,
    }
)
_OF_COUNTS = {"l_len": b"", "l_empty": I64_EQZ, "l_last": constant(I64, 1) + I64_SUB}
_QUESTIONS = {"h_isinf": "==", "h_isfinite": "<", "h_isnan": "!<="}
_OF_MOMENTS: Mapping[str, Callable[[_FunctionCodegen], bytes]] = MappingProxyType(
    {
        "m_nsec": _FunctionCodegen._nanoseconds,
        "m_sec": _FunctionCodegen._seconds,
        "m_seconds": lambda codegen: codegen._routine((I64,), in_seconds, result=F64),
    }
)

STATEMENTS: Mapping[type[nodes.FormNode], Callable[[_FunctionCodegen, Any], bytes] | nodes.Left] = (
    MappingProxyType(
        {
            nodes.Evaluate: _FunctionCodegen._evaluate,
            nodes.If: _FunctionCodegen._if,
            nodes.Loop: _FunctionCodegen._loop,
            nodes.ForEach: _FunctionCodegen._for_each,
            nodes.Break: _FunctionCodegen._break,
            nodes.Continue: _FunctionCodegen._continue,
            nodes.Select: _FunctionCodegen._select,
            nodes.Return: _FunctionCodegen._return,
            nodes.Leave: _FunctionCodegen._leave,
            nodes.Charge: _FunctionCodegen._charge,
            nodes.Allocate: _FunctionCodegen._allocate,
            nodes.LimitDepth: nodes.Left("calls a recursive function"),
            nodes.Drop: _FunctionCodegen._drop,
            nodes.Reset: _FunctionCodegen._reset,
            nodes.StopMessage: _FunctionCodegen._stop,
            nodes.Publish: nodes.Left("publishes a message"),
            nodes.AfterText: _FunctionCodegen._after_text,
            nodes.Count: _FunctionCodegen._count,
            nodes.AfterElements: _FunctionCodegen._after_elements,
            nodes.Skip: _FunctionCodegen._skip,
            nodes.NotPast: _FunctionCodegen._not_past,
            nodes.Ends: _FunctionCodegen._ends,
            nodes.ReadNumbers: _FunctionCodegen._read_numbers,
            nodes.ReadValue: _FunctionCodegen._read_value,
            nodes.Require: _FunctionCodegen._require,
            nodes.Pending: _FunctionCodegen._pending,
            nodes.WriteBack: _FunctionCodegen._write_back,
        }
    )
)
EXPRESSIONS: Mapping[type[nodes.FormNode], Callable[[_FunctionCodegen, Any], bytes] | nodes.Left] = (
    MappingProxyType(
        {
            nodes.Literal: _FunctionCodegen._literal,
            nodes.Read: _FunctionCodegen._read,
            nodes.Assign: _FunctionCodegen._assign,
            nodes.Convert: _FunctionCodegen._convert,
            nodes.Arithmetic: _FunctionCodegen._arithmetic,
            nodes.Unary: _FunctionCodegen._unary,
            nodes.Moment: _FunctionCodegen._moment,
            nodes.MomentOf: _FunctionCodegen._moment_of,
            nodes.Compare: _FunctionCodegen._compare,
            nodes.CompareTexts: _FunctionCodegen._compare_texts,
            nodes.Logical: _FunctionCodegen._logical,
            nodes.Not: _FunctionCodegen._not,
            nodes.Conditional: _FunctionCodegen._conditional,
            nodes.Sequence: _FunctionCodegen._sequence,
            nodes.Discard: nodes.Left("discards a value within an expression"),
            nodes.Item: _FunctionCodegen._item,
            nodes.Vector: nodes.Left("builds an array"),
            nodes.Zero: _FunctionCodegen._zero,
            nodes.Copy: nodes.Left("copies an array or a message"),
            nodes.Recast: nodes.Left("converts an array of bytes"),
            nodes.OfType: nodes.Left("handles values of any type"),
            nodes.Call: _FunctionCodegen._call,
            nodes.Accumulate: _FunctionCodegen._accumulate,
            nodes.Invoke: _FunctionCodegen._invoke,
            nodes.Format: nodes.Left("formats text"),
            nodes.Join: nodes.Left("joins strings"),
            nodes.Log: _FunctionCodegen._log,
            nodes.Throttle: _FunctionCodegen._throttle,
            nodes.Now: _FunctionCodegen._now,
            nodes.Altered: _FunctionCodegen._altered,
            nodes.SenderName: nodes.Left("compares the sender of a message with a number"),
            nodes.Whole: nodes.Left("uses MESSAGE"),
        }
    )
)
