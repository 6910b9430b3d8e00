"""Vectors of numbers that variables of the set keep, and that a function makes: assigned, changed, looked at.

A variable of the set is 8 bytes: where the first element stands and how many there are (4 bytes each). It has two
places for elements. What it was before the message at hand stays in the one: the first change of a message goes to the
other, so that a message is taken back with those 8 bytes. Of a vector that has more than `ROOM` bytes only that is
known (`BEYOND`); a message that looks at it, or makes one as large, is left.

A local variable that is changed, or holds what may change meanwhile, has a place of its own. Others are where they were
copied from: in the message.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from appliance.rosmop.ir import form
from appliance.rosmop.ir.layout import ROOM, NotScalarError, is_signed, machine_type
from appliance.rosmop.ir.places import root_of
from appliance.rosmop.ir.texts import Texts, turns
from appliance.rosmop.ir.values import struct_code, struct_size
from appliance.rosmop.ir.wasm import (
    COMPARE,
    END,
    F32,
    F64,
    I32,
    I64,
    IF,
    LOAD,
    NOTHING,
    RETURN,
    SELECT,
    STORE,
    constant,
    row,
    unsigned,
)
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type

_WRAP, _ADD, _SUB, _SAME = b"\xa7", b"\x7c", b"\x7d", b"\x46"
_OVER, _AT_LEAST = b"\x56", b"\x5a"  # without a sign
_COPY, _FILL = b"\xfc\x0a\x00\x00", b"\xfc\x0b\x00"


MOST_SORTED = 64
"""Elements that are sorted at once."""


@dataclass(frozen=True)
class _Room:
    """A vector that may change: its variable, the elements and their size, where it has room, and where the variable
    stands (None: it is a local one).
    """

    name: str
    element: Type
    size: int
    begin: int
    cell: int | None

    @property
    def most(self) -> bytes:
        """How many elements have room."""
        return constant(I64, ROOM // self.size)


class Vectors(Texts):
    """Writes what keeps, makes and changes vectors."""

    _made: frozenset[str] = frozenset()
    """The local variables that have a place of their own."""

    @abstractmethod
    def _sorting(self, element: Type) -> int:
        """The number of the function that `sorting` writes."""

    def _room(self, node: form.Read | form.Assign) -> _Room:
        kind, cells = node.type, self._layout.shared.get(node.name)
        if not isinstance(kind, kinds.Vector) or not kinds.is_number(kind.element):
            raise NotScalarError(str(kind))
        size = struct_size(struct_code(kind.element) or "")
        if cells is not None:
            if node.name not in cells.vectors:
                cells.vectors[node.name] = self._layout.room(2 * ROOM + 8)
            at = cells.address(node.name, kind)
            return _Room(node.name, kind.element, size, cells.vectors[node.name], at)
        if node.name not in self._made:
            raise NotScalarError(f"{kind} of a message")
        if node.name not in self._rooms:
            self._rooms[node.name] = self._layout.room(ROOM)
        return _Room(node.name, kind.element, size, self._rooms[node.name], None)

    def _place_in(self, room: _Room) -> bytes:
        return self._get(f"place of {room.name}") if room.cell is None else self._cell(0x28, room.cell)

    def _count_in(self, room: _Room) -> bytes:
        return (
            self._get(f"count of {room.name}", I64) if room.cell is None else self._cell(0x35, room.cell + 4)
        )

    def _counted(self, room: _Room, count: bytes) -> bytes:
        """There are so many elements now."""
        self._assigned.add(room.name)
        if room.cell is None:
            return count + self._set(f"count of {room.name}", I64)
        return self._cell(0x36, room.cell + 4, count + _WRAP)

    def _known(self, room: _Room) -> bytes:
        """The message is left where the vector is not here."""
        if room.cell is None:
            return b""
        return self._when(self._count_in(room) + room.most + _OVER, self._elsewhere)

    def _fresh(self, room: _Room, copied: bytes = b"") -> bytes:
        """What it was before this message is kept; `copied` brings the elements to where it is from now on."""
        self._assigned.add(room.name)
        if room.cell is None:
            return constant(I32, room.begin) + self._set(f"place of {room.name}")
        current, begin = self._cell(0x28, room.cell), constant(I32, room.begin)
        is_old = current + self._cell(0x28, room.begin + 2 * ROOM) + _SAME
        other = constant(I32, room.begin + ROOM) + begin + current + begin + _SAME + SELECT
        moved = other + self._set("fresh") + copied + self._cell(0x36, room.cell, self._get("fresh"))
        return self._when(is_old, lambda: moved)

    def _changing(self, room: _Room) -> bytes:
        """The elements may be written."""
        size = self._bytes(room, self._count_in(room))
        return self._fresh(room, self._get("fresh") + self._place_in(room) + size + _COPY)

    def _bytes(self, room: _Room, count: bytes) -> bytes:
        return count + _WRAP + constant(I32, room.size) + b"\x6c"

    def _behind(self, room: _Room, count: bytes) -> bytes:
        """The address behind so many elements."""
        return self._place_in(room) + self._bytes(room, count) + b"\x6a"

    def _stored(self, room: _Room, address: bytes, value: bytes) -> bytes:
        return address + value + bytes((_stores(machine_type(room.element), room.size), 0, 0))

    def _given(self, node: form.Expression) -> tuple[bytes, bytes]:
        """What puts a number into a local variable, and what gets it."""
        machine, code = machine_type(node.type), self._value(node)
        name = f"given {len(self._locals)}"
        return code + self._set(name, machine), self._get(name, machine)

    # Looked at

    def _elements(self, node: form.Expression) -> tuple[bytes, bytes, bytes]:
        if not isinstance(node.type, kinds.Vector):
            return super()._elements(node)
        if isinstance(node, form.Assign):
            code = self._assigned_vector(node)
            first, place, count = self._elements(form.Read(node.type, node.name))
            return code + first, place, count
        if not isinstance(node, form.Read) or not (
            node.name in self._layout.shared or node.name in self._made
        ):
            return super()._elements(node)
        room = self._room(node)
        place, count = self._place_in(room), self._count_in(room)
        return (b"", place, count) if room.cell is None else self._noted(place + count, ROOM // room.size)

    # Assigned

    def _assigned_vector(self, node: form.Assign) -> bytes:
        shared = self._layout.shared
        if node.name in shared or node.name in self._made:
            return self._copied(self._room(node), node.value)
        root = root_of(node.value)
        if not root or root in shared or root in self._made:
            raise NotScalarError(str(node.type))
        self._assigned.add(node.name)
        code, place, count = self._elements(node.value)
        code += place + self._set(f"place of {node.name}")
        return code + count + self._set(f"count of {node.name}", I64)

    def _copied(self, room: _Room, value: form.Expression) -> bytes:
        """Give a vector other elements."""
        if isinstance(value, form.Zero | form.Vector):
            return self._listed(room, value)
        if isinstance(value, form.Call) and value.function in ("l_filled", "e_fill"):
            return self._filled(room, value)
        if not isinstance(value, form.Copy):
            raise NotScalarError(str(value.type))
        first, place, count = self._elements(value)
        code = first + self._when(count + room.most + _OVER, self._elsewhere) + self._fresh(room)
        code += self._place_in(room) + place + self._bytes(room, count) + _COPY
        return code + self._counted(room, count)

    def _listed(self, room: _Room, value: form.Zero | form.Vector) -> bytes:
        items: Sequence[form.Expression] = value.items if isinstance(value, form.Vector) else ()
        assert isinstance(value.type, kinds.Vector)  # noqa: S101  as its variable
        zeros = value.zeros if isinstance(value, form.Vector) else value.type.length or 0
        if (len(items) + zeros) * room.size > ROOM:
            raise NotScalarError(str(value.type))
        code, given = b"", []
        for item in items:
            first, one = self._given(item)
            code += first
            given.append(one)
        code += self._fresh(room)
        for number, one in enumerate(given):
            code += self._stored(room, self._behind(room, constant(I64, number)), one)
        if zeros:
            rest = constant(I32, 0) + constant(I32, zeros * room.size) + _FILL
            code += self._behind(room, constant(I64, len(items))) + rest
        return code + self._counted(room, constant(I64, len(items) + zeros))

    def _filled(self, room: _Room, value: form.Call) -> bytes:
        """`std::vector<T>(count)`, `std::vector<T>(count, value)`."""
        code, count = self._given(value.arguments[0])
        first, one = self._given(value.arguments[1]) if value.function == "e_fill" else (b"", b"")
        code += first + self._when(count + room.most + _OVER, self._elsewhere)
        code += self._allocated(count + constant(I64, 8 if one else room.size) + b"\x7e")
        code += self._spend(count + constant(I64, 4) + b"\x80") + self._fresh(room)
        if not one:
            zeros = self._place_in(room) + constant(I32, 0) + self._bytes(room, count) + _FILL
            return code + zeros + self._counted(room, count)
        left = f"left {len(self._locals)}"
        each = self._stored(room, self._behind(room, self._get(left, I64)), one)
        self._brief = False
        code += count + self._set(left, I64) + self._times(left, each)
        return code + self._counted(room, count)

    # Changed

    def _opened(self, node: form.Call) -> tuple[_Room, bytes, list[bytes]]:
        """The vector that a function changes, what comes first, and what gets each number that it is given."""
        values, *others = node.arguments
        if not isinstance(values, form.Read):
            raise NotScalarError(str(values.type))
        room, code, given = self._room(values), b"", []
        with self._apart(values):
            for other in others:
                if isinstance(other, form.OfType) or (
                    isinstance(other, form.Literal) and other.value is None
                ):
                    continue
                first, one = self._given(other)
                code += first
                given.append(one)
        return room, code + self._known(room), given

    def _append(self, node: form.Call) -> bytes:
        room, code, (value, _) = self._opened(node)
        count = self._count_in(room)
        code += self._when(count + room.most + _AT_LEAST, self._elsewhere) + self._changing(room)
        code += self._stored(room, self._behind(room, count), value)
        return code + self._counted(room, count + constant(I64, 1) + _ADD) + constant(I32, 0)

    def _pop(self, node: form.Call) -> bytes:
        room, code, _ = self._opened(node)
        count = self._count_in(room)
        code += self._when(count + b"\x50", self._elsewhere)
        return code + self._counted(room, count + constant(I64, 1) + _SUB) + constant(I32, 0)

    def _clear(self, node: form.Call) -> bytes:
        room, code, _ = self._opened(node)
        return code + self._counted(room, constant(I64, 0)) + constant(I32, 0)

    def _resized(self, node: form.Call) -> bytes:
        room, code, (size, _) = self._opened(node)
        count = self._count_in(room)
        more = size + count + _SUB

        def longer() -> bytes:
            code = self._when(size + room.most + _OVER, self._elsewhere)
            code += self._allocated(more + constant(I64, room.size) + b"\x7e")
            code += self._spend(more + constant(I64, 4) + b"\x80") + self._changing(room)
            return code + self._behind(room, count) + constant(I32, 0) + self._bytes(room, more) + _FILL

        code += self._when(size + count + _OVER, longer)
        return code + self._counted(room, size) + constant(I32, 0)

    def _put(self, node: form.Call) -> bytes:
        room, code, (index, value) = self._opened(node)
        code += self._when(index + self._count_in(room) + _AT_LEAST, self._elsewhere) + self._changing(room)
        return code + self._stored(room, self._behind(room, index), value) + value

    def _erase(self, node: form.Call) -> bytes:
        room, code, (first, *rest) = self._opened(node)
        last = rest[0] if rest else first + constant(I64, 1) + _ADD
        count = self._count_in(room)
        code += self._within_span(first, last, count)
        code += self._spend(count + first + _SUB + constant(I64, 64) + b"\x80") + self._changing(room)
        code += self._behind(room, first) + self._behind(room, last)
        code += self._bytes(room, count + last + _SUB) + _COPY
        return code + self._counted(room, count + last + first + _SUB + _SUB) + constant(I32, 0)

    def _insert(self, node: form.Call) -> bytes:
        room, code, (at, value, _) = self._opened(node)
        count = self._count_in(room)
        code += self._within_span(at, count, count)
        code += self._when(count + room.most + _AT_LEAST, self._elsewhere)
        code += self._spend(count + constant(I64, 64) + b"\x80") + self._changing(room)
        code += self._behind(room, at + constant(I64, 1) + _ADD) + self._behind(room, at)
        code += self._bytes(room, count + at + _SUB) + _COPY
        code += self._stored(room, self._behind(room, at), value)
        return code + self._counted(room, count + constant(I64, 1) + _ADD) + constant(I32, 0)

    def _sort(self, node: form.Call) -> bytes:
        room, code, (first, last) = self._opened(node)
        many = last + first + _SUB
        code += self._within_span(first, last, self._count_in(room))
        code += self._when(many + constant(I64, MOST_SORTED) + _OVER, self._elsewhere)
        code += self._spend(many + constant(I64, 64) + many + b"\x79" + _SUB + b"\x7e") + self._changing(room)
        self._brief = False
        call = b"\x10" + unsigned(self._sorting(room.element))
        code += self._when(self._behind(room, first) + self._behind(room, last) + call, self._elsewhere)
        return code + constant(I32, 0)

    def _within_span(self, first: bytes, last: bytes, count: bytes) -> bytes:
        """The message is left unless 0 <= first <= last <= count."""
        return self._when(first + last + _OVER + last + count + _OVER + b"\x72", self._elsewhere)


OF_VECTORS: Mapping[str, Callable[[Vectors, form.Call], bytes]] = MappingProxyType(
    {
        "a_put": Vectors._put,
        "k_erase": Vectors._erase,
        "k_insert": Vectors._insert,
        "k_sort": Vectors._sort,
        "l_append": Vectors._append,
        "l_clear": Vectors._clear,
        "l_pop": Vectors._pop,
        "l_resized": Vectors._resized,
    }
)
"""What writes each function that changes a vector."""


def sorting(element: Type) -> bytes:
    """A function of two addresses (i32), between which elements are put into order, equal ones as they were; it returns
    whether there is one that has no order.
    """
    codes, machine = struct_code(element) or "", machine_type(element)
    size = struct_size(codes)
    more = COMPARE[machine][">"] + (machine in (I32, I64) and not is_signed(element))
    first, end, at, to, value = (b"\x20" + unsigned(local) for local in range(5))
    set_at, set_to, set_value = (b"\x21" + unsigned(local) for local in (2, 3, 4))
    load, store = bytes((LOAD[codes], 0, 0)), bytes((_stores(machine, size), 0, 0))
    before = to + constant(I32, size) + b"\x6b"
    unordered = (
        value + value + bytes((COMPARE[machine]["!="],)) + IF + NOTHING + constant(I32, 1) + RETURN + END
    )
    above = before + load + value + bytes((more,)) + b"\x45"
    moved = turns(to + first + _SAME + b"\x0d\x01" + above, to + before + load + store, before + set_to)
    each = at + load + set_value + unordered + at + set_to + moved + to + value + store
    ordered = turns(at + end + _SAME, each, at + constant(I32, size) + b"\x6a" + set_at)
    made = row([unsigned(2) + bytes((I32,)), unsigned(1) + bytes((machine,))])
    whole = made + first + set_at + ordered + constant(I32, 0) + END
    return unsigned(len(whole)) + whole


def _stores(machine: int, size: int) -> int:
    return {F32: 0x38, F64: 0x39}.get(machine, STORE[size])


def made_in(body: Sequence[form.Statement], shared: Mapping[str, object]) -> frozenset[str]:
    """The local variables of a function that are given vectors which need a place of their own."""
    sources: dict[str, list[form.Expression]] = {}
    changed = set()
    for node in form.nodes(body):
        if isinstance(node, form.Assign) and isinstance(node.type, kinds.Vector):
            sources.setdefault(node.name, []).append(node.value)
        elif isinstance(node, form.Call) and node.function in OF_VECTORS:
            changed.add(root_of(node.arguments[0]))
    own = {
        name: {root_of(value) for value in values}
        for name, values in sources.items()
        if name not in shared and not any(isinstance(value, form.Read) for value in values)
    }
    made = {
        name for name, roots in own.items() if name in changed or "" in roots or not roots.isdisjoint(shared)
    }
    while more := {name for name, roots in own.items() if not roots.isdisjoint(made)} - made:
        made |= more
    return frozenset(made)
