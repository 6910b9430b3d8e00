"""Generate code for strings and arrays of numbers or strings: constants, of the message, and variables of the set.

While a batch is processed, the bytes of a variable may be in a message, in a constant, in the arena, or in the former
memory of another variable, so assignments copy nothing, and a topic that keeps an array must not change an
element in the message. An element of a variable is changed in a copy in the arena, which the message makes (`_put`).
At the end of a batch all are copied (`settling`), to one of two buffers in turn, because lines of
output may still read the strings of the last batch. A value longer than `most_kept` is marked `BEYOND`;
messages that bring or read it are left to the interpreter.
"""

from rosmop.fast.abi import ARENA, MARK, MAX_TEXTS, Cells, is_kept, is_texts, kept_size, most_kept, room_of
from rosmop.fast.codegen_access import MessageAccess
from rosmop.fast.memory_layout import MemoryLayout, NotCompiledError, machine_type
from rosmop.fast.wasm import (
    BLOCK,
    DROP,
    ELSE,
    END,
    F64,
    I32,
    I32_ADD,
    I32_AND,
    I32_EQ,
    I32_EQZ,
    I32_GE_U,
    I32_GT_U,
    I32_LE_U,
    I32_LT_U,
    I32_MUL,
    I32_NE,
    I32_SUB,
    I32_WRAP_I64,
    I64,
    I64_DIV_U,
    I64_EQ,
    I64_EXTEND_I32_U,
    I64_GE_U,
    I64_GT_U,
    I64_LT_U,
    I64_NE,
    IF,
    LOOP,
    MEMORY_COPY,
    NOTHING,
    SELECT,
    br,
    br_if,
    compare,
    constant,
    f64_store,
    function,
    i32_load,
    i32_load8_u,
    i32_load16_u,
    i32_store,
    i64_load,
    i64_load8_u,
    i64_load32_u,
    if_result,
    load,
    local_get,
    local_set,
    store,
)
from rosmop.form import nodes
from rosmop.runtime.action_context import BYTES_PER_INSTRUCTION
from rosmop.types import value_types

_LOADS = {1: (I32, i32_load8_u), 2: (I32, i32_load16_u), 4: (I32, i32_load), 8: (I64, i64_load)}


class StringCodegen(MessageAccess):
    """Writes code that reads and keeps strings."""

    def _elements(self, node: nodes.Expression) -> tuple[bytes, bytes, bytes]:
        at = self._address_of_span(node)
        if at is not None:
            code = load(I32, at) + constant(I32, 0) + i64_load32_u(at + 4)
            return self._noted(code, most_kept(node.type))
        if isinstance(node, nodes.Literal | nodes.Zero) and kept_size(node.type):
            return self._constant_elements(node)
        if not isinstance(node.type, value_types.StringType):
            return super()._elements(node)
        if isinstance(node, nodes.Assign):
            code = self._assigned_text(node)
            first, place, count = self._elements(nodes.Read(node.type, node.name))
            return code + first, place, count
        if isinstance(node, nodes.Conditional):
            return self._chosen(node)
        return super()._elements(node)

    def _address_of_span(self, node: nodes.Expression) -> int | None:
        if isinstance(node, nodes.SenderName):
            return self._layout.sender(self._context) + 8 * (node.part == "caller")
        if isinstance(node, nodes.Read) and node.name in self._layout.shared and is_kept(node.type):
            return self._layout.variable(node.name, node.type)
        return None

    def _constant_elements(self, node: nodes.Literal | nodes.Zero) -> tuple[bytes, bytes, bytes]:
        size = kept_size(node.type)
        length = node.type.length if isinstance(node.type, value_types.VectorType) else None
        raw = node.value if isinstance(node, nodes.Literal) else bytes(size * (length or 0))
        assert isinstance(raw, bytes)  # noqa: S101  a constant of strings or arrays
        self._layout.strings.add(raw)
        return b"", constant(I32, self._layout.constant(raw)), constant(I64, len(raw) // size)

    def _noted(self, span: bytes, most: int | None = None) -> tuple[bytes, bytes, bytes]:
        place, count = (f"{what} {len(self._locals)}" for what in ("place", "count"))
        code = span + self._set(count, I64) + self._set(place)
        if most is not None:
            code += self._when(self._get(count, I64) + constant(I64, most) + I64_GT_U, self._elsewhere)
        return code, self._get(place), self._get(count, I64)

    def _chosen(self, node: nodes.Conditional) -> tuple[bytes, bytes, bytes]:
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
        first, place, count = self._elements(node.value)
        cells = self._layout.shared.get(node.name)
        if cells is None:
            code = first + place + count + self._set(f"count of {node.name}", I64)
            return code + self._set(f"place of {node.name}")
        at = self._layout.variable(node.name, node.type)
        code, place, count = self._noted(first + place + count, most_kept(node.type))
        if is_texts(node.type):
            size = place + count + I32_WRAP_I64 + self._routine((I32, I32), size_of_texts)
            long = size + constant(I32, room_of(node.type) - 4 * MAX_TEXTS) + I32_GT_U
            code += self._when(long, self._elsewhere)
        elif self._changes(node.value):
            copy, size = (
                f"copy {len(self._locals)}",
                count + I32_WRAP_I64 + constant(I32, kept_size(node.type)) + I32_MUL,
            )
            code += self._take(size, copy) + self._get(copy) + place + size + MEMORY_COPY
            place = self._get(copy)
        self._assigned.add(node.name)
        return code + store(I32, at, place) + store(I32, at + 4, count + I32_WRAP_I64)

    def _changes(self, node: nodes.Expression) -> bool:
        """Whether this may be an array of which an element is assigned: another name for it would see that."""
        names = {one.name for one in nodes.walk((node,)) if isinstance(one, nodes.Read)}
        return not names.isdisjoint(self._layout.changed.intersection(self._layout.shared))

    def _keep_name(self, node: nodes.Expression) -> None:
        if self._changes(node):
            raise NotCompiledError("gives another name to an array whose elements are assigned")

    def _put(self, node: nodes.Call) -> bytes:
        """Assign an element of a variable, in the copy that this message has made in the arena."""
        vector, index, value = node.arguments
        at = self._address_of_span(vector)
        if at is None or machine_type(node.type) != F64:
            raise NotCompiledError.of(vector.type)
        assert isinstance(vector, nodes.Read)  # noqa: S101  a span of a variable
        number, arena, size = len(self._locals), self._layout.arena(), kept_size(vector.type)
        where, new, copy = (f"{what} {number}" for what in ("where", "new", "copy"))
        with self._apart(vector):
            code = self._value(index) + self._set(where, I64) + self._value(value) + self._set(new, F64)
        first, place, count = self._elements(vector)
        code += first + self._when(self._get(where, I64) + count + I64_GE_U, self._elsewhere)
        mine = load(I32, at) + constant(I32, arena) + load(I32, MARK) + I32_ADD + I32_GE_U
        mine += load(I32, at) + constant(I32, arena + ARENA) + I32_LT_U + I32_AND

        def copy_code() -> bytes:
            length = count + I32_WRAP_I64 + constant(I32, size) + I32_MUL
            made = self._take(length, copy) + self._get(copy) + place + length + MEMORY_COPY
            return made + store(I32, at, self._get(copy))

        code += self._when(mine + I32_EQZ, copy_code)
        self._assigned.add(vector.name)
        element = (
            load(I32, at) + self._get(where, I64) + I32_WRAP_I64 + constant(I32, size) + I32_MUL + I32_ADD
        )
        return code + element + self._get(new, F64) + f64_store(0) + self._get(new, F64)

    def _cleared(self, node: nodes.Call) -> bytes:
        [vector] = node.arguments
        at = self._address_of_span(vector)
        if at is None:
            raise NotCompiledError.of(vector.type)
        assert isinstance(vector, nodes.Read)  # noqa: S101  a span of a variable
        self._assigned.add(vector.name)
        return store(I32, at + 4, constant(I32, 0)) + constant(I32, 0)

    def _compare_texts(self, node: nodes.CompareTexts) -> bytes:
        given, known = (
            (node.right, node.left) if isinstance(node.left, nodes.Literal) else (node.left, node.right)
        )
        if node.operator in ("==", "!=") and node.short and isinstance(known, nodes.Literal):
            return self._is_constant(given, known) + (I32_EQZ if node.operator == "!=" else b"")
        code, place, count = self._noted(b"".join(self._elements(node.left)))
        first, other, length = self._noted(b"".join(self._elements(node.right)))
        code += first
        if not node.short:
            long = count + constant(I64, nodes.SHORT) + I64_GT_U
            if isinstance(node.right, nodes.Read):
                long += length + constant(I64, nodes.SHORT) + I64_GT_U + I32_AND
            spent = count + constant(I64, BYTES_PER_INSTRUCTION) + I64_DIV_U
            code += self._when(long, lambda: self._spend(spent))
        if not any(self._is_bounded(side) for side in (node.left, node.right)):
            self._brief = False
        call = self._routine((I32, I32, I32), mismatch)
        if node.operator in ("==", "!="):
            same = place + other + count + I32_WRAP_I64 + call + I64_EXTEND_I32_U + count + I64_EQ
            alike = count + length + I64_EQ + if_result(I32) + same + ELSE + constant(I32, 0) + END
            return code + alike + (I32_EQZ if node.operator == "!=" else b"")
        number = len(self._locals)
        least, at = f"least {number}", f"mismatch {number}"
        code += count + length + count + length + I64_LT_U + SELECT + I32_WRAP_I64 + self._set(least)
        code += place + other + self._get(least) + call + self._set(at)
        differs = compare(I64, node.operator, signed=False)
        one, two = (side + self._get(at) + I32_ADD + i64_load8_u(0) for side in (place, other))
        ends = self._get(at) + self._get(least) + I32_EQ + if_result(I32)
        return code + ends + count + length + differs + ELSE + one + two + differs + END

    def _is_bounded(self, node: nodes.Expression) -> bool:
        return isinstance(node, nodes.Literal) or (
            isinstance(node, nodes.Read) and node.name in self._layout.shared
        )

    def _is_constant(self, given: nodes.Expression, known: nodes.Literal) -> bytes:
        assert isinstance(known.value, bytes)  # noqa: S101  a constant of strings
        first, place, count = self._elements(given)
        if len(known.value) > nodes.SHORT:
            raise NotCompiledError.of(given.type)
        same, at = constant(I32, 1), 0
        while at < len(known.value):
            size = max(size for size in (1, 2, 4, 8) if size <= len(known.value) - at)
            number = int.from_bytes(known.value[at : at + size], "little")
            machine, instruction = _LOADS[size]
            same += place + instruction(at) + constant(machine, number)
            same += compare(machine, "==") + I32_AND
            at += size
        as_long = count + constant(I64, len(known.value)) + I64_EQ
        return first + as_long + if_result(I32) + same + ELSE + constant(I32, 0) + END


def turns(leave: bytes, *turn: bytes) -> bytes:
    return BLOCK + LOOP + leave + br_if(1) + b"".join(turn) + br(0) + END + END


def mismatch() -> bytes:
    one, other, size, at = (local_get(local) for local in range(4))

    def compare(read: bytes, differs: bytes) -> bytes:
        return one + at + I32_ADD + read + other + at + I32_ADD + read + differs + br_if(1)

    def on(more: int) -> bytes:
        return at + constant(I32, more) + I32_ADD + local_set(3)

    few = size + at + I32_SUB + constant(I32, 8) + I32_LT_U
    long = turns(few, compare(i64_load(0), I64_NE), on(8))
    short = turns(at + size + I32_EQ, compare(i32_load8_u(0), I32_NE), on(1))
    return function([(1, I32)], long + short + at)


def size_of_texts() -> bytes:
    """Write a function of a table and its count: how many bytes its strings take, with their lengths."""
    entry, left, size = (local_get(local) for local in range(3))
    more = size + entry + i32_load(0) + i32_load(0) + I32_ADD + constant(I32, 4) + I32_ADD + local_set(2)
    # A sum beyond all that is kept is enough, before it wraps.
    enough = size + constant(I32, 1 << 24) + I32_GT_U + br_if(1)
    on = entry + constant(I32, 4) + I32_ADD + local_set(0) + left + constant(I32, 1) + I32_SUB + local_set(1)
    return function([(1, I32)], turns(left + I32_EQZ, more, enough, on) + size)


def moved_texts() -> bytes:
    """Write a function that copies a table, its count and its strings to an address, and returns the address."""
    to, entry, left, new, place, size = (local_get(local) for local in range(6))
    begin = to + local_set(3) + to + constant(I32, 4 * MAX_TEXTS) + I32_ADD + local_set(4)
    text = entry + i32_load(0) + i32_load(0) + constant(I32, 4) + I32_ADD + local_set(5)
    text += place + entry + i32_load(0) + size + MEMORY_COPY + new + place + i32_store(0)
    on = place + size + I32_ADD + local_set(4)
    on += b"".join(
        which + constant(I32, 4) + I32_ADD + local_set(local) for which, local in ((entry, 1), (new, 3))
    )
    on += left + constant(I32, 1) + I32_SUB + local_set(2)
    return function([(3, I32)], begin + turns(left + I32_EQZ, text, on) + to)


def settling(layout: MemoryLayout, cells: Cells, copy_texts: bytes) -> bytes:
    """Copy the strings and arrays of all variables to one of their two buffers, in turn, and return 0 (i32).

    The number of the current buffer is stored last. A stopped function runs again after the current message is
    undone.
    """
    cells.generation = layout.take(8)
    kept = {at: kind for at, kind in cells.variables.values() if is_kept(kind)}
    rooms = {at: room_of(kind) for at, kind in kept.items()}
    cells.texts = {at: layout.take(2 * room) for at, room in rooms.items()}
    other, target = local_get(0), local_get(1)
    flip = load(I32, cells.generation) + I32_EQZ + local_set(0)
    code = []
    for address, begin in cells.texts.items():
        count, kind = load(I32, address + 4), kept[address]
        moved = target + load(I32, address) + count
        if is_texts(kind):
            moved += copy_texts + DROP
        else:
            moved += constant(I32, kept_size(kind)) + I32_MUL + MEMORY_COPY
        code += [
            count, constant(I32, most_kept(kind)), I32_LE_U, IF, NOTHING,
            other, constant(I32, rooms[address]), I32_MUL, constant(I32, begin), I32_ADD + local_set(1),
            moved,
            store(I32, address, target),
            END,
        ]  # fmt: skip
    code += [store(I32, cells.generation, other), constant(I32, 0)]
    return function([(2, I32)], flip + b"".join(code))
