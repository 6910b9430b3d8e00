"""Strings: constants, those of the message, and those that variables of the set keep.

A variable is 8 bytes: where the string begins and how long it is (4 bytes each). While messages are looked at that may
be in a message, in a constant, or where any variable's string stood before, so that to assign one copies nothing.
When a walk ends all are copied together (`settling`) to where the strings of the walk before the last one stood: what
lines of output show stays as it was until they are made.

A string longer than `MOST_KEPT` is not kept here: the message that brings it is left, and of a variable that holds one
only that is known (`BEYOND`); the message that looks at it is left.
"""

from rosmop.fast.abi import MOST_KEPT, Cells
from rosmop.fast.codegen_access import Places
from rosmop.fast.memory_layout import Layout, NotScalarError
from rosmop.fast.wasm import (
    COMPARE,
    ELSE,
    END,
    I32,
    I64,
    IF,
    NOTHING,
    SELECT,
    constant,
    load,
    row,
    store,
    unsigned,
)
from rosmop.form import nodes
from rosmop.runtime.action_context import BYTES_PER_INSTRUCTION
from rosmop.types import value_types


class Texts(Places):
    """Writes what looks at strings."""

    def _elements(self, node: nodes.Expression) -> tuple[bytes, bytes, bytes]:
        if not isinstance(node.type, value_types.String):
            return super()._elements(node)
        if isinstance(node, nodes.Literal | nodes.Zero):
            raw = node.value if isinstance(node, nodes.Literal) else b""
            assert isinstance(raw, bytes)  # noqa: S101  a constant of strings
            self._layout.strings.add(raw)
            return b"", constant(I32, self._layout.constant(raw)), constant(I64, len(raw))
        if isinstance(node, nodes.Assign):
            code = self._assigned_text(node)
            first, place, count = self._elements(nodes.Read(node.type, node.name))
            return code + first, place, count
        if isinstance(node, nodes.Conditional):
            return self._chosen(node)
        if isinstance(node, nodes.Read) and node.name in self._layout.shared:
            at = self._layout.variable(node.name, node.type)
            code = self._cell(0x28, at) + self._cell(0x35, at + 4)
            return self._noted(code, MOST_KEPT)
        return super()._elements(node)

    def _noted(self, span: bytes, most: int | None = None) -> tuple[bytes, bytes, bytes]:
        """Address and length from the stack in local variables; left if it is longer than `most`."""
        place, count = (f"{what} {len(self._locals)}" for what in ("place", "count"))
        code = span + self._set(count, I64) + self._set(place)
        if most is not None:
            code += self._when(self._get(count, I64) + constant(I64, most) + b"\x56", self._elsewhere)
        return code, self._get(place), self._get(count, I64)

    def _chosen(self, node: nodes.Conditional) -> tuple[bytes, bytes, bytes]:
        """One of two, of which only that is looked at."""
        test = self._value(node.test)
        place, count = (f"{what} {len(self._locals)}" for what in ("place", "count"))
        self._local(place, I32)
        self._local(count, I64)

        def branch(value: nodes.Expression) -> bytes:
            first, begin, length = self._elements(value)
            return first + begin + self._set(place) + length + self._set(count, I64)

        code = self._when(test, lambda: branch(node.yes), lambda: branch(node.no))
        return code, self._get(place), self._get(count, I64)

    def _assigned_text(self, node: nodes.Assign) -> bytes:
        """Give a string to a variable."""
        first, place, count = self._elements(node.value)
        cells = self._layout.shared.get(node.name)
        if cells is None:
            code = first + place + count + self._set(f"count of {node.name}", I64)
            return code + self._set(f"place of {node.name}")
        at = self._layout.variable(node.name, node.type)
        code, place, count = self._noted(first + place + count, MOST_KEPT)
        self._assigned.add(node.name)
        return code + self._cell(0x36, at, place) + self._cell(0x36, at + 4, count + b"\xa7")

    def _compare_texts(self, node: nodes.CompareTexts) -> bytes:
        given, known = (
            (node.right, node.left) if isinstance(node.left, nodes.Literal) else (node.left, node.right)
        )
        if node.operator in ("==", "!=") and node.short and isinstance(known, nodes.Literal):
            return self._is_constant(given, known) + (b"\x45" if node.operator == "!=" else b"")
        code, place, count = self._noted(b"".join(self._elements(node.left)))
        first, other, length = self._noted(b"".join(self._elements(node.right)))
        code += first
        if not node.short:
            long = count + constant(I64, nodes.SHORT) + b"\x56"
            if isinstance(node.right, nodes.Read):
                long += length + constant(I64, nodes.SHORT) + b"\x56\x71"
            spent = count + constant(I64, BYTES_PER_INSTRUCTION) + b"\x80"
            code += self._when(long, lambda: self._spend(spent))
        if not any(self._is_bounded(side) for side in (node.left, node.right)):
            self._brief = False
        call = self._routine(3, mismatch)
        if node.operator in ("==", "!="):
            same = place + other + count + b"\xa7" + call + b"\xad" + count + b"\x51"
            alike = count + length + b"\x51" + IF + bytes((I32,)) + same + ELSE + constant(I32, 0) + END
            return code + alike + (b"\x45" if node.operator == "!=" else b"")
        number = len(self._locals)
        least, at = f"least {number}", f"mismatch {number}"
        code += count + length + count + length + b"\x54" + SELECT + b"\xa7" + self._set(least)
        code += place + other + self._get(least) + call + self._set(at)
        opcode = bytes((COMPARE[I64][node.operator] + 1,))  # without a sign
        one, two = (side + self._get(at) + b"\x6a\x31\x00\x00" for side in (place, other))
        ends = self._get(at) + self._get(least) + b"\x46" + IF + bytes((I32,))
        return code + ends + count + length + opcode + ELSE + one + two + opcode + END

    def _is_bounded(self, node: nodes.Expression) -> bool:
        return isinstance(node, nodes.Literal) or (
            isinstance(node, nodes.Read) and node.name in self._layout.shared
        )

    def _is_constant(self, given: nodes.Expression, known: nodes.Literal) -> bytes:
        """Whether a string is a short constant: as long, and the same bytes."""
        assert isinstance(known.value, bytes)  # noqa: S101  a constant of strings
        first, place, count = self._elements(given)
        if len(known.value) > nodes.SHORT:
            raise NotScalarError("std::string")
        same, at = constant(I32, 1), 0
        while at < len(known.value):
            size = max(size for size in (1, 2, 4, 8) if size <= len(known.value) - at)
            number = int.from_bytes(known.value[at : at + size], "little")
            machine, opcode = {1: (I32, 0x2D), 2: (I32, 0x2F), 4: (I32, 0x28), 8: (I64, 0x29)}[size]
            same += place + bytes((opcode, 0)) + unsigned(at) + constant(machine, number)
            same += bytes((COMPARE[machine]["=="],)) + b"\x71"
            at += size
        as_long = count + constant(I64, len(known.value)) + b"\x51"
        return first + as_long + IF + bytes((I32,)) + same + ELSE + constant(I32, 0) + END


def _function(made: int, *code: bytes) -> bytes:
    """A function with so many local variables (i32)."""
    whole = row([unsigned(made) + bytes((I32,))]) + b"".join(code) + END
    return unsigned(len(whole)) + whole


def turns(leave: bytes, *turn: bytes) -> bytes:
    """A loop that ends when `leave` is true, or a turn leaves its block."""
    return b"\x02\x40\x03\x40" + leave + b"\x0d\x01" + b"".join(turn) + b"\x0c\x00" + END + END


def mismatch() -> bytes:
    """A function of two addresses and a length (i32): where the first byte is that differs, or the length."""
    one, other, size, at = (b"\x20" + unsigned(local) for local in range(4))

    def compared(opcodes: bytes) -> bytes:
        read, differs = opcodes[:1] + b"\x00\x00", opcodes[1:]
        return one + at + b"\x6a" + read + other + at + b"\x6a" + read + differs + b"\x0d\x01"

    def on(more: int) -> bytes:
        return at + constant(I32, more) + b"\x6a\x21\x03"

    few = size + at + b"\x6b" + constant(I32, 8) + b"\x49"
    return _function(
        1,
        turns(few, compared(b"\x29\x52"), on(8)),
        turns(at + size + b"\x46", compared(b"\x2d\x47"), on(1)),
        at,
    )


def settling(layout: Layout, cells: Cells) -> bytes:
    """A function that copies the strings of all variables to where they stay until the next time but one: each has two
    places.

    That there is another place now is said last: one that is stopped is begun again when what the message at hand
    has done is taken back. It returns 0 (i32).
    """
    cells.generation = layout.take(8)
    cells.texts = {at: layout.take(2 * MOST_KEPT) for at in cells.kept}
    other, target = b"\x20\x00", b"\x20\x01"
    flip = load(I32, cells.generation) + b"\x45\x21\x00"
    code = []
    for address, begin in cells.texts.items():
        count = load(I32, address + 4)
        code += [
            count, constant(I32, MOST_KEPT), b"\x4d", IF, NOTHING,
            other, constant(I32, MOST_KEPT), b"\x6c", constant(I32, begin), b"\x6a\x21\x01",
            target, load(I32, address), count, b"\xfc\x0a\x00\x00",
            store(I32, address, target),
            END,
        ]  # fmt: skip
    return _function(2, flip, *code, store(I32, cells.generation, other), constant(I32, 0))
