"""Lines of output of which a module keeps the values, so that their text is made of them later.

A line stands in the module's memory as its number among those of the module, the address of the frame (i32 each), and 8
bytes for each value: an integer, a double, or a string's address (the low 32 bits) and length. It costs the most that
it can: text is not made before it is paid for.
"""

import struct
from collections.abc import Callable, Sequence

from appliance.rosmop.ir import form
from appliance.rosmop.ir.functions import FAULTING, FUNCTIONS
from appliance.rosmop.runtime.context import BYTES_PER_INSTRUCTION, OUTPUT_COST
from appliance.rosmop.runtime.output import MAX_PRECISION
from appliance.rosmop.types import kinds

HEAD = struct.Struct("<II")
"""The number of a line and where its frame is."""

BYTES = BYTES_PER_INSTRUCTION // 4
"""Of a string, for an instruction more."""

_PIECE = 512  # bytes that a number may take
_SHORT = 1024  # bytes of a text whose size is not charged
_Make = Callable[[Sequence[object]], object]


class Line:
    """A line: the `values` that it is made of, and how many bytes it may have besides those of its strings."""

    def __init__(self, node: form.Log, context: str) -> None:
        self.level = node.level
        self.context = context
        self.values: list[form.Expression] = []
        self.longest = 0
        self._make = self._made(node.text)
        self._texts = [place for place, expression in enumerate(self.values) if is_text(expression)]
        self._slots = struct.Struct("<" + "".join(map(_code, self.values)))
        self.size = HEAD.size + self._slots.size

    @property
    def cost(self) -> int:
        """Instructions: with one for each `BYTES` of its strings at least what is taken for it."""
        return OUTPUT_COST + 3 * (self.longest // BYTES_PER_INSTRUCTION + 1)  # formatted, joined and put out

    def text(self, memory: memoryview, at: int) -> bytes:
        """The text of a line that stands there."""
        values: list[object] = [*self._slots.unpack_from(memory, at + HEAD.size)]
        for place in self._texts:
            where, size = divmod(values[place], 1 << 32)[::-1]  # type: ignore[operator]  # an integer
            values[place] = bytes(memory[where : where + size])
        text = self._make(values)
        assert isinstance(text, bytes)  # noqa: S101  as its type says
        return text

    def _made(self, node: form.Expression) -> _Make:
        """How a part of the text is made of the values."""
        if isinstance(node, form.Literal):
            constant = node.value
            self.longest += len(constant) if isinstance(constant, bytes) else 0
            return lambda _: constant
        if isinstance(node, form.Format):
            self.longest += _SHORT if node.size is None else node.size
            parts, template = [self._made(part) for part in node.arguments], node.template
            return lambda values: template % tuple(part(values) for part in parts)
        if isinstance(node, form.Join):
            parts = [self._made(piece) for piece in node.pieces]
            return lambda values: b"".join(part(values) for part in parts)  # type: ignore[misc]  # they are bytes
        if isinstance(node, form.Call) and node.function.startswith("p_") and _goes_on(node):
            self.longest += _PIECE
            function, parts = FUNCTIONS[node.function], [self._made(argument) for argument in node.arguments]
            site = (node.site,) if node.function in FAULTING else ()
            return lambda values: function(*(part(values) for part in parts), *site)
        place = len(self.values)
        self.values.append(node)
        return lambda values: values[place]


def is_text(node: form.Expression) -> bool:
    """Whether a value is a string."""
    return isinstance(node.type, kinds.String)


def _goes_on(node: form.Call) -> bool:
    """Whether it does not fault: of those that can the precision is a constant that is not too large."""
    if node.function not in FAULTING:
        return True
    digits = node.arguments[1]
    return (
        isinstance(digits, form.Literal)
        and isinstance(digits.value, int)
        and 0 <= digits.value <= MAX_PRECISION
    )


def _code(node: form.Expression) -> str:
    if isinstance(node.type, kinds.Floating):
        return "d"
    return "Q" if is_text(node) or (isinstance(node.type, kinds.Integer) and not node.type.signed) else "q"
