"""Lines of output and published messages of which a module keeps the values, so that they are made of them later.

A line stands in the module's memory as its number among those of the module, the address of the frame (i32 each), and 8
bytes for each value: an integer, a double, or a string's address (the low 32 bits) and length. It costs the most that
it can: text is not made before it is paid for.

A message that is published has behind number and frame its fields as they are sent, of strings and arrays of any
length where they are and how long.
"""

import struct
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from rosmop.form import nodes
from rosmop.runtime.context import BYTES_PER_INSTRUCTION, OUTPUT_COST, LogLine, Published, line_of
from rosmop.runtime.formatting import MAX_PRECISION
from rosmop.runtime.functions import FAULTING, FUNCTIONS
from rosmop.types import kinds

HEAD = struct.Struct("<II")
"""The number of a line or publication and where its frame is."""

BYTES = BYTES_PER_INSTRUCTION // 4
"""Of a string, for an instruction more."""

_ADDRESS = 0xFFFFFFFF
_TEXT = struct.Struct("<II")
_LENGTH = struct.Struct("<I")
_PIECE = 512  # bytes that a number may take
_SHORT = 1024  # bytes of a text whose size is not charged
_Make = Callable[[Sequence[object]], object]


class _Noted(msgspec.Struct, tag=True, array_like=True, dict=True):
    """What is noted of values, and how they are read: data that can be sent, and what is made of them."""

    context: str

    def _note(self, values: Sequence[nodes.Expression]) -> None:
        self._texts = [place for place, expression in enumerate(values) if is_text(expression)]
        self._slots = struct.Struct("<" + "".join(map(_code, values)))
        self.size = HEAD.size + self._slots.size

    def values_at(self, memory: memoryview, at: int) -> list[Any]:
        """Those that stand there."""
        values: list[Any] = [*self._slots.unpack_from(memory, at + HEAD.size)]
        for place in self._texts:
            text = values[place]
            where = text & _ADDRESS
            values[place] = bytes(memory[where : where + (text >> 32)])
        return values


class Line(_Noted):
    """A line: the `values` that it is made of, and how many bytes it may have besides those of its strings."""

    node: nodes.Log

    def __post_init__(self) -> None:
        self.values: list[nodes.Expression] = []
        self.longest = 0
        self._make = self._made(self.node.text)
        self._note(self.values)

    @property
    def cost(self) -> int:
        """Instructions: with one for each `BYTES` of its strings at least what is taken for it."""
        return OUTPUT_COST + 3 * (self.longest // BYTES_PER_INSTRUCTION + 1)  # formatted, joined and put out

    def put_out(self, memory: memoryview, at: int, monitor: str) -> LogLine:
        """The line that stands there."""
        text = self._make(self.values_at(memory, at))
        assert isinstance(text, bytes)  # noqa: S101  as its type says
        return line_of(self.node.level, text, monitor)

    def _made(self, node: nodes.Expression) -> _Make:
        """How a part of the text is made of the values."""
        if isinstance(node, nodes.Literal):
            constant = node.value
            self.longest += len(constant) if isinstance(constant, bytes) else 0
            return lambda _: constant
        if isinstance(node, nodes.Format):
            self.longest += _SHORT if node.size is None else node.size
            parts, template = [self._made(part) for part in node.arguments], node.template
            return lambda values: template % tuple(part(values) for part in parts)
        if isinstance(node, nodes.Join):
            parts = [self._made(piece) for piece in node.pieces]
            return lambda values: b"".join(part(values) for part in parts)  # type: ignore[misc]  # they are bytes
        if isinstance(node, nodes.Call) and node.function.startswith("p_") and _goes_on(node):
            self.longest += _PIECE
            function, parts = FUNCTIONS[node.function], [self._made(argument) for argument in node.arguments]
            site = (node.site,) if node.function in FAULTING else ()
            return lambda values: function(*(part(values) for part in parts), *site)
        place = len(self.values)
        self.values.append(node)
        return lambda values: values[place]


class Publication(msgspec.Struct, tag=True, array_like=True, dict=True):
    """A message that is published; `room` and `texts`: the bytes of what is noted of it, and where its strings and
    arrays of any length are, each with the bytes of an element.
    """

    context: str
    node: nodes.Publish
    room: int
    texts: Sequence[tuple[int, int]]

    def __post_init__(self) -> None:
        self.cost = OUTPUT_COST + self.room
        self.size = HEAD.size + -(-self.room // 8) * 8

    def put_out(self, memory: memoryview, at: int, monitor: str) -> Published:
        """The message that stands there."""
        node, begin = self.node, at + HEAD.size
        if not self.texts:
            data = bytes(memory[begin : begin + self.room])
            return Published(monitor, node.topic, node.kind.name, data, node.site)
        done = begin
        pieces: list[bytes | memoryview] = []
        for text, size in self.texts:
            where, count = _TEXT.unpack_from(memory, begin + text)
            pieces += (memory[done : begin + text], _LENGTH.pack(count), memory[where : where + count * size])
            done = begin + text + _TEXT.size
        pieces.append(memory[done : begin + self.room])
        return Published(monitor, node.topic, node.kind.name, b"".join(pieces), node.site)


def is_text(node: nodes.Expression) -> bool:
    """Whether a value is a string."""
    return isinstance(node.type, kinds.String)


def _goes_on(node: nodes.Call) -> bool:
    """Whether it does not fault: of those that can the precision is a constant that is not too large."""
    if node.function not in FAULTING:
        return True
    digits = node.arguments[1]
    return (
        isinstance(digits, nodes.Literal)
        and isinstance(digits.value, int)
        and 0 <= digits.value <= MAX_PRECISION
    )


def _code(node: nodes.Expression) -> str:
    if isinstance(node.type, kinds.Floating):
        return "d"
    return "Q" if is_text(node) or (isinstance(node.type, kinds.Integer) and not node.type.signed) else "q"
