"""What stands in a message: positions, numbers, and strings, arrays and messages where they stand.

In a local variable is the address, and how many elements there are. Of an array of strings it is the address of a table
that says where each begins.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from rosmop.fast.abi import REST
from rosmop.fast.arithmetic import Arithmetic
from rosmop.fast.memory_layout import NotScalarError, machine_type
from rosmop.fast.wasm import I32, I64, LOAD, constant, unsigned
from rosmop.form import nodes
from rosmop.runtime.times import BILLION
from rosmop.runtime.values import struct_code, struct_size
from rosmop.runtime.wire import MAX_EMPTY
from rosmop.types import value_types
from rosmop.types.value_types import Type

MOST_TEXTS = 256
"""Strings of an array that is read; one of more is left."""


class Places(Arithmetic):
    """Writes what looks at the message."""

    def _position(self, at: nodes.Spot) -> bytes:
        """A position, in 64 bits: the lengths in a message are not to be trusted."""
        offset = constant(I64, at.offset)
        return offset if at.base is None else self._get(at.base, I64) + offset + b"\x7c"

    def _length(self) -> bytes:
        """The bytes of all of the message, in 64 bits."""
        return self._get("size") + b"\xad" + self._cell(0x29, REST) + b"\x7c"

    def _within(self, at: nodes.Spot, size: int) -> bytes:
        """A fault unless so many bytes of the message stand there."""
        short = self._get("size") + b"\xad" + self._position(at.plus(size)) + b"\x54"
        return self._when(short, self._elsewhere)

    def _at(self, at: nodes.Spot, opcode: int) -> tuple[bytes, bytes]:
        """What stands before and in an access of the message at a position that is within it."""
        base = self._get("at") + (b"" if at.base is None else self._get(at.base, I64) + b"\xa7\x6a")
        return base, bytes((opcode, 0)) + unsigned(at.offset)

    def _after_text(self, node: nodes.AfterText) -> bytes:
        length = b"".join(self._at(node.at, 0x28)) + b"\xad"
        end = self._position(node.at.plus(4)) + length + b"\x7c"
        return self._within(node.at, 4) + end + self._set(node.name, I64)

    def _count(self, node: nodes.Count) -> bytes:
        """The number of elements, in 64 bits; a fault if so many are not there."""
        code = self._within(node.at, 4) + b"".join(self._at(node.at, 0x28)) + b"\xad"
        number = self._get(node.name, I64)
        room = self._get("size") + b"\xad" + self._position(node.at.plus(4)) + b"\x7d"
        least = number + constant(I64, node.least) + b"\x7e"
        if not node.least:
            least, room = number, constant(I64, MAX_EMPTY)
        return code + self._set(node.name, I64) + self._when(least + room + b"\x56", self._elsewhere)

    def _after_elements(self, node: nodes.AfterElements) -> bytes:
        count = constant(I64, node.count) if isinstance(node.count, int) else self._get(node.count, I64)
        end = self._position(node.at) + count + constant(I64, node.size) + b"\x7e\x7c"
        return end + self._set(node.name, I64)

    def _read_numbers(self, node: nodes.ReadNumbers) -> bytes:
        end = max(offset + struct_size(struct_code(kind) or "") for _, kind, offset in node.fields)
        code = self._within(node.at, end)
        for name, kind, offset in node.fields:
            place = self._get("at")
            place += b"" if node.at.base is None else self._get(node.at.base, I64) + b"\xa7\x6a"
            code += loaded(place, node.at.offset + offset, kind) + self._set(name, machine_type(kind))
        return code

    def _read_value(self, node: nodes.ReadValue) -> bytes:
        place, count, start = f"place of {node.name}", f"count of {node.name}", node.at
        if isinstance(node.type, value_types.Record):
            size = self._layout.size(node.type)
            code = self._within(start, size) + self._get("at") + self._position(start) + b"\xa7\x6a"
            return code + self._set(place) + self._position(start.plus(size)) + self._set(node.end, I64)
        element, size = self._layout.element(node.type)
        if isinstance(element, value_types.String):
            return self._read_texts(node)
        if isinstance(node.type, value_types.Vector) and node.type.length is not None:
            code = self._within(start, node.type.length * size)
            code += constant(I64, node.type.length) + self._set(count, I64)
        else:
            code, start = self._count(nodes.Count(node.site, count, start, size)), start.plus(4)
        code += self._get("at") + self._position(start) + b"\xa7\x6a" + self._set(place)
        return code + self._after_elements(nodes.AfterElements(node.site, node.end, start, count, size))

    def _read_texts(self, node: nodes.ReadValue) -> bytes:
        """Note where each string of an array begins."""
        if isinstance(node.type, value_types.Vector) and node.type.length is not None:
            raise NotScalarError(str(node.type))
        count, left, entry = (
            f"count of {node.name}",
            f"left {len(self._locals)}",
            f"entry {len(self._locals)}",
        )
        table = constant(I32, self._layout.take(4 * MOST_TEXTS))
        code = self._count(nodes.Count(node.site, count, node.at, 4))
        many = self._get(count, I64) + constant(I64, MOST_TEXTS) + b"\x56"
        code += self._when(many, self._elsewhere) + self._get(count, I64) + self._set(left, I64)
        code += self._position(node.at.plus(4)) + self._set(node.end, I64) + table + self._set(entry)
        each = self._get(entry) + self._get("at") + self._get(node.end, I64) + b"\xa7\x6a\x36\x00\x00"
        each += self._after_text(nodes.AfterText(node.site, node.end, nodes.Spot(node.end, 0)))
        beyond = self._get(node.end, I64) + self._get("size") + b"\xad\x56"
        each += self._when(beyond, self._elsewhere)
        each += self._get(entry) + constant(I32, 4) + b"\x6a" + self._set(entry)
        return code + self._times(left, each) + table + self._set(f"place of {node.name}")

    def _text_at(self, entry: bytes) -> tuple[bytes, bytes, bytes]:
        """The string that begins where an entry of a table says, as `_elements`."""
        name = f"text {len(self._locals)}"
        first = entry + b"\x28\x00\x00" + self._set(name)
        return first, self._get(name) + constant(I32, 4) + b"\x6a", self._get(name) + b"\x28\x00\x00\xad"

    def _elements(self, node: nodes.Expression) -> tuple[bytes, bytes, bytes]:
        """What comes first; the address of the first element of a string or vector, and how many there are (i64)."""
        if isinstance(node, nodes.Copy):
            first, place, count = self._elements(node.value)
            element, size = self._layout.element(node.type)
            machine_type(element)
            return first + self._allocated(count + constant(I64, size) + b"\x7e"), place, count
        if (
            isinstance(node.type, value_types.String)
            and isinstance(node, nodes.Call)
            and node.function == "l_element"
        ):
            return self._text_at(self._address_of(node))
        if (
            isinstance(node, nodes.Item)
            and isinstance(node.type, value_types.Vector)
            and node.type.length is not None
        ):
            first, place = self._place(node)
            return first, place, constant(I64, node.type.length)
        if not isinstance(node, nodes.Read) or f"place of {node.name}" not in self._locals:
            raise NotScalarError(str(node.type))
        return b"", self._get(f"place of {node.name}"), self._get(f"count of {node.name}", I64)

    def _place(self, node: nodes.Expression) -> tuple[bytes, bytes]:
        """What comes first; the address of a message within this one, or of an array of fixed length."""
        if isinstance(node, nodes.Copy):
            self._layout.copied(node.type)
            return self._place(node.value)
        if isinstance(node, nodes.Item):
            first, place = self._place(node.base)
            return first, place + constant(I32, self._layout.offset(node.base.type, node.number)) + b"\x6a"
        if isinstance(node, nodes.Call) and node.function == "l_element":
            name, code = f"element {len(self._locals)}", self._address_of(node)
            return code + self._set(name), self._get(name)
        if not isinstance(node, nodes.Read) or f"place of {node.name}" not in self._locals:
            raise NotScalarError(str(node.type))
        return b"", self._get(f"place of {node.name}")

    @contextmanager
    def _apart(self, *looked_at: nodes.Expression) -> Iterator[None]:
        """What is written here does not change what is looked at; raises `NotScalarError` if it does."""
        names = {
            root_of(node)
            for node in looked_at
            if isinstance(node.type, value_types.Vector | value_types.Record)
        }
        before, self._assigned = self._assigned, set()
        try:
            yield
            if not names.isdisjoint(self._assigned):
                raise NotScalarError("a vector or message that changes while it is looked at")
        finally:
            self._assigned |= before

    def _address_of(self, node: nodes.Call) -> bytes:
        """The address of an element."""
        values, index = node.arguments
        _, size = self._layout.element(values.type)
        first, place, count = self._elements(values)
        with self._apart(values):
            code = first + self._value(index) + self._set("index", I64)
        past = self._get("index", I64) + count + b"\x5a"
        code += self._when(past, self._elsewhere)
        return code + place + self._get("index", I64) + b"\xa7" + constant(I32, size) + b"\x6c\x6a"

    def _element_at(self, node: nodes.Call) -> bytes:
        code = self._address_of(node) + self._set("element")
        return code + loaded(self._get("element"), 0, node.type)

    def _item(self, node: nodes.Item) -> bytes:
        machine_type(node.type)
        first, place = self._place(node.base)
        return first + loaded(place, self._layout.offset(node.base.type, node.number), node.type)


def loaded(place: bytes, offset: int, kind: Type) -> bytes:
    """A number or time so many bytes behind a place."""
    codes = struct_code(kind) or ""
    if len(codes) == 2:
        extend = b"\xad" if codes[0] == "I" else b"\xac"
        seconds, rest = (place + b"\x28\x00" + unsigned(offset + more) + extend for more in (0, 4))
        return seconds + constant(I64, BILLION) + b"\x7e" + rest + b"\x7c"
    code = place + bytes((LOAD[codes], 0)) + unsigned(offset)
    return code + (b"\x45\x45" if codes == "?" else b"")


def root_of(node: nodes.Expression) -> str:
    """The variable that a value is, is in, or is copied from; none where that is not plain."""
    while not isinstance(node, nodes.Read | nodes.Assign):
        if isinstance(node, nodes.Copy):
            node = node.value
        elif isinstance(node, nodes.Item):
            node = node.base
        elif isinstance(node, nodes.Call) and node.function == "l_element":
            node = node.arguments[0]
        else:
            return ""
    return node.name if node.type != value_types.VOID else ""  # that holds what a function has handed back
