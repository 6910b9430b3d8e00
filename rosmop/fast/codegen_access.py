"""Code that reads a message: positions, numbers, and strings, arrays and messages in place.

Local variables hold the address and the number of elements. For an array of strings, this is the address of a table of
their addresses; for messages of variable size, of a table of rows (`MemoryLayout.row`). The address of such a message
is that of its row.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from rosmop.fast.abi import ARENA, MAX_TEXTS, REST, USED
from rosmop.fast.arithmetic import ArithmeticCodegen
from rosmop.fast.memory_layout import NotCompiledError, machine_type
from rosmop.fast.wasm import (
    I32,
    I32_ADD,
    I32_EQZ,
    I32_GT_U,
    I32_MUL,
    I32_WRAP_I64,
    I64,
    I64_ADD,
    I64_EXTEND_I32_S,
    I64_EXTEND_I32_U,
    I64_GE_U,
    I64_GT_U,
    I64_LT_U,
    I64_MUL,
    I64_SUB,
    compare,
    constant,
    f32_load,
    f64_load,
    i32_load,
    i32_load8_s,
    i32_load8_u,
    i32_load16_s,
    i32_load16_u,
    i32_store,
    i64_load,
    load,
    store,
)
from rosmop.form import nodes
from rosmop.runtime.times import BILLION
from rosmop.runtime.values import struct_code, struct_size
from rosmop.runtime.wire import MAX_EMPTY
from rosmop.types import value_types
from rosmop.types.value_types import Type

MAX_ROWS = 4096

WIDTH = 32  # bytes of a string in C++

_LOADS = {
    "?": i32_load8_u, "b": i32_load8_s, "B": i32_load8_u, "h": i32_load16_s, "H": i32_load16_u,
    "i": i32_load, "I": i32_load, "q": i64_load, "Q": i64_load, "f": f32_load, "d": f64_load,
}  # fmt: skip


class MessageAccess(ArithmeticCodegen):
    """Writes code that reads the message."""

    def _position(self, at: nodes.Spot) -> bytes:
        """Push a position in 64 bits, because lengths in a message are untrusted."""
        offset = constant(I64, at.offset)
        return offset if at.base is None else self._get(at.base, I64) + offset + I64_ADD

    def _length(self) -> bytes:
        return self._get("size") + I64_EXTEND_I32_U + load(I64, REST) + I64_ADD

    def _within(self, at: nodes.Spot, size: int) -> bytes:
        short = self._get("size") + I64_EXTEND_I32_U + self._position(at.plus(size)) + I64_LT_U
        return self._when(short, self._elsewhere)

    def _length_at(self, at: nodes.Spot) -> bytes:
        base = self._get("at") + (
            b"" if at.base is None else self._get(at.base, I64) + I32_WRAP_I64 + I32_ADD
        )
        return base + i32_load(at.offset) + I64_EXTEND_I32_U

    def _after_text(self, node: nodes.AfterText) -> bytes:
        end = self._position(node.at.plus(4)) + self._length_at(node.at) + I64_ADD
        return self._within(node.at, 4) + end + self._set(node.name, I64)

    def _count(self, node: nodes.Count) -> bytes:
        code = self._within(node.at, 4) + self._length_at(node.at)
        number = self._get(node.name, I64)
        room = self._get("size") + I64_EXTEND_I32_U + self._position(node.at.plus(4)) + I64_SUB
        least = number + constant(I64, node.least) + I64_MUL
        if not node.least:
            least, room = number, constant(I64, MAX_EMPTY)
        return code + self._set(node.name, I64) + self._when(least + room + I64_GT_U, self._elsewhere)

    def _after_elements(self, node: nodes.AfterElements) -> bytes:
        count = constant(I64, node.count) if isinstance(node.count, int) else self._get(node.count, I64)
        end = self._position(node.at) + count + constant(I64, node.size) + I64_MUL + I64_ADD
        return end + self._set(node.name, I64)

    def _ends(self, node: nodes.Ends) -> bytes:
        differs = self._position(node.at) + self._length() + compare(I64, "!=")
        return self._when(differs, self._elsewhere)

    def _read_numbers(self, node: nodes.ReadNumbers) -> bytes:
        end = max(offset + struct_size(struct_code(kind) or "") for _, kind, offset in node.fields)
        code = self._within(node.at, end)
        for name, kind, offset in node.fields:
            place = self._get("at")
            place += b"" if node.at.base is None else self._get(node.at.base, I64) + I32_WRAP_I64 + I32_ADD
            code += load_code(place, node.at.offset + offset, kind) + self._set(name, machine_type(kind))
        return code

    def _read_value(self, node: nodes.ReadValue) -> bytes:
        place, count, start = f"place of {node.name}", f"count of {node.name}", node.at
        if self._is_row(node.type) or (
            isinstance(node.type, value_types.VectorType)
            and node.type.length is None
            and self._is_row(node.type.element)
        ):
            return self._read_rows(node)
        if isinstance(node.type, value_types.RecordType):
            size = self._layout.size(node.type)
            code = self._within(start, size) + self._get("at") + self._position(start)
            code += I32_WRAP_I64 + I32_ADD + self._set(place)
            return code + self._position(start.plus(size)) + self._set(node.end, I64)
        element, size = self._layout.element(node.type)
        if isinstance(element, value_types.StringType):
            return self._read_texts(node)
        if isinstance(node.type, value_types.VectorType) and node.type.length is not None:
            code = self._within(start, node.type.length * size)
            code += constant(I64, node.type.length) + self._set(count, I64)
        else:
            code, start = self._count(nodes.Count(node.site, count, start, size)), start.plus(4)
        code += self._get("at") + self._position(start) + I32_WRAP_I64 + I32_ADD + self._set(place)
        return code + self._after_elements(nodes.AfterElements(node.site, node.end, start, count, size))

    def _read_texts(self, node: nodes.ReadValue) -> bytes:
        if isinstance(node.type, value_types.VectorType) and node.type.length is not None:
            raise NotCompiledError.of(node.type)
        count, left, entry = (
            f"count of {node.name}",
            f"left {len(self._locals)}",
            f"entry {len(self._locals)}",
        )
        place = f"place of {node.name}"
        code = self._count(nodes.Count(node.site, count, node.at, 4))
        code += self._few(count, MAX_TEXTS) + self._get(count, I64) + self._set(left, I64)
        code += self._take(self._get(count, I64) + I32_WRAP_I64 + constant(I32, 4) + I32_MUL, place)
        code += (
            self._position(node.at.plus(4)) + self._set(node.end, I64) + self._get(place) + self._set(entry)
        )
        begin = self._get("at") + self._get(node.end, I64) + I32_WRAP_I64 + I32_ADD
        each = self._get(entry) + begin + i32_store(0)
        each += self._after_text(nodes.AfterText(node.site, node.end, nodes.Spot(node.end, 0)))
        beyond = self._get(node.end, I64) + self._get("size") + I64_EXTEND_I32_U + I64_GT_U
        each += self._when(beyond, self._elsewhere)
        each += self._get(entry) + constant(I32, 4) + I32_ADD + self._set(entry)
        return code + self._times(left, each)

    def _few(self, count: str, most: int) -> bytes:
        return self._when(self._get(count, I64) + constant(I64, most) + I64_GT_U, self._elsewhere)

    def _take(self, size: bytes, name: str) -> bytes:
        """Take bytes (i32) of the arena, and name their address."""
        arena, taken = self._layout.arena(), f"taken {len(self._locals)}"
        code = load(I32, USED) + self._set(name) + self._get(name) + size + I32_ADD + self._set(taken)
        code += self._when(self._get(taken) + constant(I32, ARENA) + I32_GT_U, self._elsewhere)
        code += store(I32, USED, self._get(taken))
        return code + self._get(name) + constant(I32, arena) + I32_ADD + self._set(name)

    # Messages of variable size

    def _is_row(self, kind: Type) -> bool:
        return isinstance(kind, value_types.RecordType) and self._layout.varies(kind)

    def _read_rows(self, node: nodes.ReadValue) -> bytes:
        count, left, entry = (f"{what} of {node.name}" for what in ("count", "left", "entry"))
        kind, start, code = node.type, node.at, constant(I64, 1) + self._set(count, I64)
        if isinstance(kind, value_types.VectorType):
            kind, start = kind.element, start.plus(4)
            code = self._count(nodes.Count(node.site, count, node.at, self._layout.least(kind)))
            code += self._few(count, MAX_ROWS)
        place, row = f"place of {node.name}", constant(I32, self._layout.row(kind))
        code += self._take(self._get(count, I64) + I32_WRAP_I64 + row + I32_MUL, place)
        code += self._get(count, I64) + self._set(left, I64) + self._get(place) + self._set(entry)
        code += self._position(start) + self._set(node.end, I64)
        each = self._noted_row(node, kind, entry, 0) + self._get(entry) + row + I32_ADD + self._set(entry)
        self._brief = False
        return code + self._times(left, each) + self._within(nodes.Spot(node.end, 0), 0)

    def _noted_row(self, node: nodes.ReadValue, kind: Type, entry: str, offset: int) -> bytes:
        """Write the row of the message at the end of `node` so far, and move this end behind the message."""
        address = self._get("at") + self._get(node.end, I64) + I32_WRAP_I64 + I32_ADD
        code, fixed, offset = self._get(entry) + address + i32_store(offset), 0, offset + 4
        for field in self._layout.fields(kind):
            if not self._layout.varies(field):
                fixed += self._layout.size(field)
                continue
            code += self._further(node.end, fixed)
            if isinstance(field, value_types.RecordType):
                code += self._noted_row(node, field, entry, offset)
                offset += self._layout.row(field)
            else:
                code += self._passed(node, field)
            code, fixed, offset = code + self._get(entry) + address + i32_store(offset), 0, offset + 4
        return code + self._further(node.end, fixed)

    def _further(self, name: str, more: int) -> bytes:
        return self._get(name, I64) + constant(I64, more) + I64_ADD + self._set(name, I64) if more else b""

    def _passed(self, node: nodes.ReadValue, kind: Type) -> bytes:
        """Move the end of `node` behind a value of variable size."""
        here = nodes.Spot(node.end, 0)
        if isinstance(kind, value_types.StringType):
            return self._after_text(nodes.AfterText(node.site, node.end, here))
        if isinstance(kind, value_types.RecordType):
            return b"".join(
                self._passed(node, field) if self._layout.varies(field)
                else self._further(node.end, self._layout.size(field))
                for field in self._layout.fields(kind)
            )  # fmt: skip
        if not isinstance(kind, value_types.VectorType):
            raise NotCompiledError.of(kind)
        inner = f"inner {len(self._locals)}"
        code = constant(I64, kind.length or 0) + self._set(inner, I64)
        if kind.length is None:
            code = self._count(nodes.Count(node.site, inner, here, self._layout.least(kind.element)))
            code += self._further(node.end, 4)
        if not self._layout.varies(kind.element):
            size = self._layout.size(kind.element)
            return code + self._after_elements(nodes.AfterElements(node.site, node.end, here, inner, size))
        return code + self._times(inner, self._passed(node, kind.element))

    def _place_of_field(self, node: nodes.Item) -> tuple[bytes, bytes]:
        first, place = self._place(node.base)
        base, distance = self._layout.place_of_field(node.base.type, node.number)
        place += b"" if base is None else i32_load(base)
        return first, place + constant(I32, distance) + I32_ADD

    def _text_at(self, entry: bytes) -> tuple[bytes, bytes, bytes]:
        name = f"text {len(self._locals)}"
        first = entry + i32_load(0) + self._set(name)
        length = self._get(name) + i32_load(0) + I64_EXTEND_I32_U
        return first, self._get(name) + constant(I32, 4) + I32_ADD, length

    def _elements(self, node: nodes.Expression) -> tuple[bytes, bytes, bytes]:
        if isinstance(node, nodes.Copy):
            first, place, count = self._elements(node.value)
            element, size = self._layout.element(node.type)
            if isinstance(element, value_types.StringType):
                size = WIDTH
            else:
                machine_type(element)
            return first + self._allocated(count + constant(I64, size) + I64_MUL), place, count
        if (
            isinstance(node.type, value_types.StringType)
            and isinstance(node, nodes.Call)
            and node.function == "l_element"
        ):
            return self._text_at(self._address_of(node))
        if isinstance(node, nodes.Item):
            return self._elements_of_field(node)
        if not isinstance(node, nodes.Read) or f"place of {node.name}" not in self._locals:
            raise NotCompiledError.of(node.type)
        return b"", self._get(f"place of {node.name}"), self._get(f"count of {node.name}", I64)

    def _elements_of_field(self, node: nodes.Item) -> tuple[bytes, bytes, bytes]:
        element, _ = self._layout.element(node.type)
        if self._layout.varies(element):
            raise NotCompiledError.of(node.type)  # it has no table
        first, place = self._place_of_field(node)
        if isinstance(node.type, value_types.VectorType) and node.type.length is not None:
            return first, place, constant(I64, node.type.length)
        name = f"field {len(self._locals)}"
        length = self._get(name) + i32_load(0) + I64_EXTEND_I32_U
        return first + place + self._set(name), self._get(name) + constant(I32, 4) + I32_ADD, length

    def _place(self, node: nodes.Expression) -> tuple[bytes, bytes]:
        if isinstance(node, nodes.Copy):
            self._layout.require_free_copy(node.type)
            return self._place(node.value)
        if isinstance(node, nodes.Item):
            return self._place_of_field(node)
        if isinstance(node, nodes.Call) and node.function == "l_element":
            name, code = f"element {len(self._locals)}", self._address_of(node)
            return code + self._set(name), self._get(name)
        if not isinstance(node, nodes.Read) or f"place of {node.name}" not in self._locals:
            raise NotCompiledError.of(node.type)
        return b"", self._get(f"place of {node.name}")

    @contextmanager
    def _apart(self, *looked_at: nodes.Expression) -> Iterator[None]:
        names = {
            root_of(node)
            for node in looked_at
            if isinstance(node.type, value_types.VectorType | value_types.RecordType)
        }
        before, self._assigned = self._assigned, set()
        try:
            yield
            if not names.isdisjoint(self._assigned):
                raise NotCompiledError("changes an array or a message while reading it")
        finally:
            self._assigned |= before

    def _address_of(self, node: nodes.Call) -> bytes:
        values, index = node.arguments
        _, size = self._layout.element(values.type)
        first, place, count = self._elements(values)
        with self._apart(values):
            code = first + self._value(index) + self._set("index", I64)
        past = self._get("index", I64) + count + I64_GE_U
        code += self._when(past, self._elsewhere)
        return code + place + self._get("index", I64) + I32_WRAP_I64 + constant(I32, size) + I32_MUL + I32_ADD

    def _element_at(self, node: nodes.Call) -> bytes:
        code = self._address_of(node) + self._set("element")
        return code + load_code(self._get("element"), 0, node.type)

    def _item(self, node: nodes.Item) -> bytes:
        machine_type(node.type)
        first, place = self._place_of_field(node)
        return first + load_code(place, 0, node.type)


def load_code(place: bytes, offset: int, kind: Type) -> bytes:
    codes = struct_code(kind) or ""
    if len(codes) == 2:
        extend = I64_EXTEND_I32_U if codes[0] == "I" else I64_EXTEND_I32_S
        seconds, rest = (place + i32_load(offset + more) + extend for more in (0, 4))
        return seconds + constant(I64, BILLION) + I64_MUL + rest + I64_ADD
    code = place + _LOADS[codes](offset)
    return code + (I32_EQZ + I32_EQZ if codes == "?" else b"")


def root_of(node: nodes.Expression) -> str:
    while not isinstance(node, nodes.Read | nodes.Assign):
        if isinstance(node, nodes.Copy):
            node = node.value
        elif isinstance(node, nodes.Item):
            node = node.base
        elif isinstance(node, nodes.Call) and node.function == "l_element":
            node = node.arguments[0]
        else:
            return ""
    return node.name if node.type != value_types.VOID else ""  # the variable with a function's result
