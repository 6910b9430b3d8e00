"""Arrays of any length of numbers, truths and times in messages that are made or kept (`records.py`).

In the message stands where the elements are, and how many (4 bytes each). They are in one part of the memory, the heap,
which a walk fills from its beginning, and of a variable of the set between walks where `texts.py` puts them.

Elements have one name only while they change: what is copied or published has the same elements, and `Layout.heap` says
which of them stay as they are from then on, as do all of the messages before. Who changes those has others.
"""

from rosmop.fast.abi import ROOM
from rosmop.fast.codegen_access import loaded, root_of
from rosmop.fast.layout import HEAP, NotScalarError
from rosmop.fast.strings_codegen import turns
from rosmop.fast.vectors_codegen import Room, Vectors, function
from rosmop.fast.wasm import (
    COMPARE,
    ELSE,
    END,
    F32,
    F64,
    I32,
    I64,
    IF,
    NOTHING,
    RETURN,
    constant,
    unsigned,
)
from rosmop.form import nodes
from rosmop.runtime.times import BILLION
from rosmop.runtime.values import is_array, struct_code, struct_size
from rosmop.types import kinds
from rosmop.types.kinds import Type

_COPY = b"\xfc\x0a\x00\x00"


class Arrays(Vectors):
    """Writes what puts arrays into messages, and changes them there."""

    def _is_message(self, node: nodes.Expression) -> bool:
        """Whether it is in a message that is made or kept here."""
        raise NotImplementedError

    def _array(self, node: nodes.Expression) -> tuple[Room, bytes]:
        if not isinstance(node, nodes.Item) or not is_array(node.type) or not self._is_message(node):
            raise NotScalarError(str(node.type))
        first, place = self._place(node)
        element, size = self._layout.element(node.type)
        name, slot = root_of(node), f"slot {len(self._locals)}"
        most = ROOM if name in self._layout.shared else HEAP
        return Room(name, element, size, 0, None, slot, most), first + place + self._set(slot)

    def _of_array(self, node: nodes.Copy) -> tuple[bytes, bytes, bytes]:
        """A copy of one, as `_elements`: the same elements, which do not change any more."""
        first, place, count = self._elements(node.value)
        _, size = self._layout.element(node.type)
        return first + self._allocated(count + constant(I64, size) + b"\x7e") + self._stay(), place, count

    def _stay(self) -> bytes:
        """All elements that there are stay as they are."""
        heap = self._layout.heap()
        return self._cell(0x36, heap + 4, self._cell(0x28, heap))

    def _claimed(self, size: int, count: bytes) -> bytes:
        """So many elements have room from where the local variable `claimed` says; before it stands how many bytes."""
        heap = self._layout.heap()
        code = self._when(count + constant(I64, HEAP // size) + b"\x56", self._elsewhere)
        room = count + b"\xa7" + constant(I32, size) + b"\x6c"
        code += self._cell(0x28, heap) + constant(I32, 8) + b"\x6a" + self._set("claimed")
        end = self._get("claimed") + room + constant(I32, 7) + b"\x6a" + constant(I32, -8) + b"\x71\x6a"
        full = self._get("claimed end") + constant(I32, heap + 8 + HEAP) + b"\x4b"
        code += end + self._set("claimed end") + self._when(full, self._elsewhere)
        code += self._cell(0x36, heap, self._get("claimed end"))
        return code + self._get("claimed") + constant(I32, 8) + b"\x6b" + room + b"\x36\x00\x00"

    def _give_array(self, place: bytes, offset: int, value: nodes.Expression, *, kept: bool) -> bytes:
        """Put an array there that a value has; a message that would put a NaN there is left."""
        shared = isinstance(value, nodes.Copy) and isinstance(value.value, nodes.Item)
        code, begin, count = self._noted(b"".join(self._elements(value)))
        if not shared:
            return code + self._put_elements(place, offset, value.type, begin, count, kept=kept)
        _, size = self._layout.element(value.type)
        if kept:
            code += self._when(count + constant(I64, ROOM // size) + b"\x56", self._elsewhere)
        return code + self._noted_array(place, offset, begin, count)

    def _put_array_at(
        self, place: bytes, offset: int, at: nodes.Spot, name: str, kind: Type, *, kept: bool
    ) -> bytes:
        """The array of the message at a position, and the position behind it."""
        _, size = self._layout.element(kind)
        begin, number = f"begin of array {name}", f"number {name}"
        code = self._count(nodes.Count(-1, number, at, size)) + self._get("at")
        code += self._position(at.plus(4)) + b"\xa7\x6a" + self._set(begin)
        code += self._after_elements(nodes.AfterElements(-1, name, at.plus(4), number, size))
        given = self._get(begin), self._get(number, I64)
        return code + self._put_elements(place, offset, kind, *given, kept=kept, sent=True)

    def _put_elements(
        self, place: bytes, offset: int, kind: Type, begin: bytes, count: bytes, *, kept: bool,
        sent: bool = False,
    ) -> bytes:  # fmt: skip
        """Copy elements; `sent`: from a message, so that a NaN of 64 bits stays what it is."""
        element, size = self._layout.element(kind)
        code = b""
        if kept:
            code += self._when(count + constant(I64, ROOM // size) + b"\x56", self._elsewhere)
        code += self._claimed(size, count)
        room = count + b"\xa7" + constant(I32, size) + b"\x6c"
        if _may_differ(element, sent=sent):
            self._brief = False
            call = begin + begin + room + b"\x6a" + self._routine(2, differing, element, sent)
            code += self._when(call, self._elsewhere)
        code += self._get("claimed") + begin + room + _COPY
        return code + self._noted_array(place, offset, self._get("claimed"), count)

    def _noted_array(self, place: bytes, offset: int, begin: bytes, count: bytes) -> bytes:
        """Put there where elements stand, and how many."""
        code = place + begin + b"\x36\x00" + unsigned(offset)
        return code + place + count + b"\xa7\x36\x00" + unsigned(offset + 4)

    def _changing(self, room: Room, needed: bytes | None = None) -> bytes:
        if not room.slot:
            return super()._changing(room, needed)
        self._assigned.add(room.name)
        heap, name = self._layout.heap(), f"elements {len(self._locals)}"
        count = self._count_in(room) if needed is None else needed
        mark = self._cell(0x28, heap + 4)
        code = self._place_in(room) + self._set(name)
        code += self._get(name) + mark + b"\x6b" + constant(I32, heap + 8 + HEAP) + mark + b"\x6b\x49"
        has = self._get(name) + constant(I32, 8) + b"\x6b\x35\x00\x00"
        has += count + constant(I64, room.size) + b"\x7e\x5a"
        code += IF + bytes((I32,)) + has + ELSE + constant(I32, 0) + END + b"\x45"

        def moved() -> bytes:
            more = count if needed is None else count + count + b"\x7c"
            moved = self._claimed(room.size, more) + self._get("claimed") + self._get(name)
            moved += self._bytes(room, self._count_in(room)) + _COPY
            return moved + self._get(room.slot) + self._get("claimed") + b"\x36\x00\x00"

        return self._when(code, moved)

    def _stored(self, room: Room, address: bytes, value: bytes) -> bytes:
        kept = {"f": F32, "d": F64}.get(struct_code(room.element) or "")
        if not room.slot or kept is None:
            return super()._stored(room, address, value)
        none = value + value + bytes((COMPARE[kept]["!="],))
        return self._when(none, self._elsewhere) + super()._stored(room, address, value)


def _may_differ(element: Type, *, sent: bool) -> bool:
    code = struct_code(element) or ""
    return len(code) == 2 or code in "?f" or (code == "d" and not sent)


def differing(element: Type, sent: bool) -> bytes:
    """A function of two addresses, between which elements stand: whether one would be others if it were written anew,
    or is a NaN that was not `sent` (a signalling one of 32 bits is quiet then).
    """
    code = struct_code(element) or ""
    size = struct_size(code)
    at, end = b"\x20\x00", b"\x20\x01"
    if isinstance(element, kinds.Bool):
        other = at + b"\x2d\x00\x00" + constant(I32, 1) + b"\x4b"
    elif len(code) == 2:
        other = at + b"\x28\x00\x04" + constant(I32, BILLION) + b"\x4f"
    else:
        value = loaded(at, 0, element)
        other = value + value + bytes((COMPARE[F32 if size == 4 else F64]["!="],))
        if sent:
            other += at + b"\x28\x00\x00" + constant(I32, 1 << 22) + b"\x71\x45\x71"
    found = other + IF + NOTHING + constant(I32, 1) + RETURN + END
    on = at + constant(I32, size) + b"\x6a\x21\x00"
    return function([], turns(at + end + b"\x46", found, on), constant(I32, 0))
