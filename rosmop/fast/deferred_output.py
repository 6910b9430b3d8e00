"""Lines of output: the module stores their values, and Python formats them later.

A stored line has its number among the module's lines, the address of the frame (i32 each), and 8 bytes for
each value: an integer, a double, or a string's address (the low 32 bits) and length. The highest possible
cost is charged, because a text must be paid for before it is made.
"""

import struct
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from rosmop.form import nodes
from rosmop.runtime.action_context import BYTES_PER_INSTRUCTION, OUTPUT_COST, LogLine, line_of
from rosmop.runtime.builtin_functions import FAULTING, FUNCTIONS
from rosmop.runtime.formatting import MAX_PRECISION
from rosmop.types import value_types

HEAD = struct.Struct("<II")

BYTES = BYTES_PER_INSTRUCTION // 4

_ADDRESS = 0xFFFFFFFF
_PIECE = 512  # the maximum number of bytes that a formatted number takes
_SHORT = 1024  # the maximum number of bytes of a text that is not charged
_Make = Callable[[Sequence[object]], object]


class OutputLine(msgspec.Struct, tag=True, array_like=True, dict=True):
    """A line that can be serialized. `longest` is the maximum number of its bytes besides strings."""

    context: str
    node: nodes.Log

    def __post_init__(self) -> None:
        self.values: list[nodes.Expression] = []
        self.longest = 0
        self._make = self._made(self.node.text)
        self._texts = [place for place, expression in enumerate(self.values) if is_text(expression)]
        self._slots = struct.Struct("<" + "".join(map(_code, self.values)))
        self.size = HEAD.size + self._slots.size

    @property
    def cost(self) -> int:
        """Return the cost in instructions, without the bytes of strings (one for each `BYTES_PER_INSTRUCTION`).

        Together they are at least the cost that the form charges.
        """
        return OUTPUT_COST + 3 * (self.longest // BYTES_PER_INSTRUCTION + 1)  # formatting, joining, output

    def put_out(self, memory: memoryview, at: int, monitor: str) -> LogLine:
        values: list[Any] = [*self._slots.unpack_from(memory, at + HEAD.size)]
        for place in self._texts:
            where, length = values[place] & _ADDRESS, values[place] >> 32
            values[place] = bytes(memory[where : where + length])
        text = self._make(values)
        assert isinstance(text, bytes)  # noqa: S101  the type says so
        return line_of(self.node.level, text, monitor)

    def _made(self, node: nodes.Expression) -> _Make:
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


def is_text(node: nodes.Expression) -> bool:
    return isinstance(node.type, value_types.StringType)


def _goes_on(node: nodes.Call) -> bool:
    if node.function not in FAULTING:
        return True
    digits = node.arguments[1]
    return (
        isinstance(digits, nodes.Literal)
        and isinstance(digits.value, int)
        and 0 <= digits.value <= MAX_PRECISION
    )


def _code(node: nodes.Expression) -> str:
    if isinstance(node.type, value_types.FloatingType):
        return "d"
    return (
        "Q"
        if is_text(node) or (isinstance(node.type, value_types.IntegerType) and not node.type.signed)
        else "q"
    )
