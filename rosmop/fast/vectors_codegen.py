"""Vectors of numbers and times that variables of the set keep, and that a function makes: assigned, changed, looked at.

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
from typing import TypeGuard

from rosmop.fast.abi import ROOM
from rosmop.fast.codegen_access import loaded, root_of
from rosmop.fast.layout import NotScalarError, is_signed, machine_type
from rosmop.fast.strings_codegen import Texts, turns
from rosmop.fast.wasm import (
    COMPARE,
    ELSE,
    END,
    F32,
    F64,
    I32,
    I64,
    IF,
    MOVES,
    NOTHING,
    RETURN,
    SELECT,
    STORE,
    constant,
    row,
    unsigned,
)
from rosmop.form import nodes
from rosmop.runtime.context import BYTES_PER_INSTRUCTION
from rosmop.runtime.values import struct_code, struct_size
from rosmop.runtime.vectors import LARGE
from rosmop.types import kinds
from rosmop.types.kinds import Type

_WRAP, _ADD, _SUB, _SAME = b"\xa7", b"\x7c", b"\x7d", b"\x46"
_OVER, _AT_LEAST = b"\x56", b"\x5a"  # without a sign
_PLUS, _MINUS = b"\x6a", b"\x6b"
_COPY, _FILL = b"\xfc\x0a\x00\x00", b"\xfc\x0b\x00"


@dataclass(frozen=True)
class Room:
    """A vector that may change: its variable, the elements and their size, where it has room, and where the variable
    stands (None: it is a local one). An array in a message is noted where a local variable, its `slot`, says, and may
    have `room` bytes (`arrays.py`).
    """

    name: str
    element: Type
    size: int
    begin: int
    cell: int | None
    slot: str = ""
    room: int = ROOM

    @property
    def most(self) -> bytes:
        """How many elements have room."""
        return constant(I64, self.room // self.size)


class Vectors(Texts):
    """Writes what keeps, makes and changes vectors."""

    _made: frozenset[str] = frozenset()
    """The local variables that have a place of their own."""
    _begun: frozenset[str] = frozenset()
    """Those of them that are elsewhere until they change: in the message, or with who calls the function."""

    @abstractmethod
    def _handed_back(self, node: nodes.Invoke) -> tuple[bytes, bytes, bytes]:
        """A string or vector that a function returns, as `_elements`; the next call may change what is there."""

    @abstractmethod
    def _after(self, node: nodes.Sequence) -> tuple[bytes, bytes, bytes]:
        """The same of one behind what is evaluated before."""

    def _room(self, node: nodes.Read | nodes.Assign) -> Room:
        kind, cells = node.type, self._layout.shared.get(node.name)
        size = self._size_of(kind)
        assert isinstance(kind, kinds.Vector)  # noqa: S101  it has a size
        if cells is not None:
            if node.name not in cells.vectors:
                cells.vectors[node.name] = self._layout.room(2 * ROOM + 8)
            at = self._layout.variable(node.name, kind)
            return Room(node.name, kind.element, size, cells.vectors[node.name], at)
        if node.name not in self._made:
            raise NotScalarError(f"{kind} of a message")
        if node.name not in self._rooms:
            self._rooms[node.name] = self._layout.room(ROOM)
        return Room(node.name, kind.element, size, self._rooms[node.name], None)

    def _size_of(self, kind: Type) -> int:
        """The bytes of an element of a vector that is kept or made. Raises `NotScalarError` of another."""
        if not isinstance(kind, kinds.Vector) or struct_code(kind.element) is None:
            raise NotScalarError(str(kind))
        return struct_size(struct_code(kind.element) or "")

    @abstractmethod
    def _array(self, node: nodes.Expression) -> tuple[Room, bytes]:
        """An array in a message that is made or kept, and what comes first. Raises `NotScalarError` of any other."""

    def _place_in(self, room: Room) -> bytes:
        if room.slot:
            return self._get(room.slot) + b"\x28\x00\x00"
        return self._get(f"place of {room.name}") if room.cell is None else self._cell(0x28, room.cell)

    def _count_in(self, room: Room) -> bytes:
        if room.slot:
            return self._get(room.slot) + b"\x35\x00\x04"
        return (
            self._get(f"count of {room.name}", I64) if room.cell is None else self._cell(0x35, room.cell + 4)
        )

    def _counted(self, room: Room, count: bytes) -> bytes:
        """There are so many elements now."""
        self._assigned.add(room.name)
        if room.slot:
            return self._get(room.slot) + count + _WRAP + b"\x36\x00\x04"
        if room.cell is None:
            return count + self._set(f"count of {room.name}", I64)
        return self._cell(0x36, room.cell + 4, count + _WRAP)

    def _known(self, room: Room) -> bytes:
        """The message is left where the vector is not here."""
        if room.cell is None and not room.slot:
            return b""
        return self._when(self._count_in(room) + room.most + _OVER, self._elsewhere)

    def _fresh(self, room: Room, copied: bytes = b"") -> bytes:
        """What it was before this message is kept; `copied` brings the elements to where it is from now on."""
        self._assigned.add(room.name)
        if room.cell is None:
            own = constant(I32, 1) + self._set(f"own {room.name}") if room.name in self._begun else b""
            return own + constant(I32, room.begin) + self._set(f"place of {room.name}")
        current, begin = self._cell(0x28, room.cell), constant(I32, room.begin)
        is_old = current + self._cell(0x28, room.begin + 2 * ROOM) + _SAME
        other = constant(I32, room.begin + ROOM) + begin + current + begin + _SAME + SELECT
        moved = other + self._set("fresh") + copied + self._cell(0x36, room.cell, self._get("fresh"))
        return self._when(is_old, lambda: moved)

    def _changing(self, room: Room, needed: bytes | None = None) -> bytes:  # noqa: ARG002  of arrays in messages
        """The elements may be written, so many as are `needed`, if more than there are."""
        size = self._bytes(room, self._count_in(room))
        if room.name not in self._begun:
            return self._fresh(room, self._get("fresh") + self._place_in(room) + size + _COPY)
        code = self._when(self._count_in(room) + room.most + _OVER, self._elsewhere)
        code += constant(I32, room.begin) + self._place_in(room) + size + _COPY + self._fresh(room)
        return self._when(self._is_elsewhere(room), lambda: code)

    def _is_elsewhere(self, room: Room) -> bytes:
        """Whether a local vector has not come to its place yet."""
        return self._get(f"own {room.name}") + b"\x45"

    def _bytes(self, room: Room, count: bytes) -> bytes:
        return count + _WRAP + constant(I32, room.size) + b"\x6c"

    def _behind(self, room: Room, count: bytes) -> bytes:
        """The address behind so many elements."""
        return self._place_in(room) + self._bytes(room, count) + b"\x6a"

    def _stored(self, room: Room, address: bytes, value: bytes) -> bytes:
        code = b""
        if len(struct_code(room.element) or "") == 2:
            code, value = self._parts_of(room.element, value)
        return code + address + value + bytes((_stores(machine_type(room.element), room.size), 0, 0))

    def _given(self, node: nodes.Expression) -> tuple[bytes, bytes]:
        """What puts a number into a local variable, and what gets it."""
        machine, code = machine_type(node.type), self._value(node)
        name = f"given {len(self._locals)}"
        return code + self._set(name, machine), self._get(name, machine)

    # Looked at

    def _elements(self, node: nodes.Expression) -> tuple[bytes, bytes, bytes]:
        if not isinstance(node.type, kinds.Vector):
            return super()._elements(node)
        if isinstance(node, nodes.Assign):
            code = self._assigned_vector(node)
            first, place, count = self._elements(nodes.Read(node.type, node.name))
            return code + first, place, count
        if isinstance(node, nodes.Zero | nodes.Vector | nodes.Invoke | nodes.Conditional) or _is_filled(node):
            name = f"made {len(self._locals)}"
            room = Room(name, node.type.element, self._size_of(node.type), self._layout.room(ROOM), None)
            return self._copied(room, node), self._place_in(room), self._count_in(room)
        if not isinstance(node, nodes.Read) or not (
            node.name in self._layout.shared or node.name in self._made
        ):
            return super()._elements(node)
        room = self._room(node)
        place, count = self._place_in(room), self._count_in(room)
        return (b"", place, count) if room.cell is None else self._noted(place + count, ROOM // room.size)

    def _compare(self, node: nodes.Compare) -> bytes:
        kind = node.left.type
        if not isinstance(kind, kinds.Vector) or struct_code(kind.element) is None:
            return super()._compare(node)
        _, size = self._layout.element(kind)
        code, place, count = self._noted(b"".join(self._elements(node.left)))
        held = count + constant(I64, size) + b"\x7e"
        spent = held + constant(I64, BYTES_PER_INSTRUCTION) + b"\x80"
        code += self._when(held + constant(I64, LARGE) + _OVER, lambda: self._spend(spent))
        with self._apart(node.left):
            first, other, length = self._noted(b"".join(self._elements(node.right)))
        self._brief = False
        end = place + count + _WRAP + constant(I32, size) + b"\x6c" + _PLUS
        call = place + end + other + self._routine(3, alike, kind.element)
        code += first + count + length + b"\x51" + IF + bytes((I32,)) + call + ELSE + constant(I32, 0) + END
        return code + (b"\x45" if node.operator == "!=" else b"")

    # Assigned

    def _assigned_vector(self, node: nodes.Assign) -> bytes:
        shared = self._layout.shared
        begins = node.name in self._begun and isinstance(node.value, nodes.Read)
        if (node.name in shared or node.name in self._made) and not begins:
            return self._copied(self._room(node), node.value)
        root = root_of(node.value)
        if not root or root in shared or root in self._made:
            raise NotScalarError(str(node.type))
        self._assigned.add(node.name)
        code, place, count = self._elements(node.value)
        code += place + self._set(f"place of {node.name}")
        return code + count + self._set(f"count of {node.name}", I64)

    def _copied(self, room: Room, value: nodes.Expression) -> bytes:
        """Give a vector other elements."""
        if isinstance(value, nodes.Zero | nodes.Vector):
            return self._listed(room, value)
        if _is_filled(value):
            return self._filled(room, value)
        if isinstance(value, nodes.Invoke):
            first, place, count = self._handed_back(value)
        elif isinstance(value, nodes.Sequence):
            first, place, count = self._after(value)
        elif isinstance(value, nodes.Conditional):
            first, place, count = self._chosen(value)
        elif isinstance(value, nodes.Copy | nodes.Item):
            first, place, count = self._elements(value)
        else:
            raise NotScalarError(str(value.type))
        code, place, count = self._noted(first + place + count)
        code += self._when(count + room.most + _OVER, self._elsewhere) + self._fresh(room)
        code += self._place_in(room) + place + self._bytes(room, count) + _COPY
        return code + self._counted(room, count)

    def _listed(self, room: Room, value: nodes.Zero | nodes.Vector) -> bytes:
        items: Sequence[nodes.Expression] = value.items if isinstance(value, nodes.Vector) else ()
        assert isinstance(value.type, kinds.Vector)  # noqa: S101  as its variable
        zeros = value.zeros if isinstance(value, nodes.Vector) else value.type.length or 0
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

    def _filled(self, room: Room, value: nodes.Call) -> bytes:
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

    def _opened(self, node: nodes.Call) -> tuple[Room, bytes, list[bytes]]:
        """The vector that a function changes, what comes first, and what gets each number that it is given."""
        values, *others = node.arguments
        room, code = (self._room(values), b"") if isinstance(values, nodes.Read) else self._array(values)
        given = []
        with self._apart(values):
            for other in others:
                if isinstance(other, nodes.OfType) or (
                    isinstance(other, nodes.Literal) and other.value is None
                ):
                    continue
                first, one = self._given(other)
                code += first
                given.append(one)
        return room, code + self._known(room), given

    def _append(self, node: nodes.Call) -> bytes:
        room, code, (value, _) = self._opened(node)
        count = self._count_in(room)
        code += self._when(count + room.most + _AT_LEAST, self._elsewhere)
        code += self._changing(room, count + constant(I64, 1) + _ADD)
        code += self._stored(room, self._behind(room, count), value)
        return code + self._counted(room, count + constant(I64, 1) + _ADD) + constant(I32, 0)

    def _pop(self, node: nodes.Call) -> bytes:
        room, code, _ = self._opened(node)
        count = self._count_in(room)
        code += self._when(count + b"\x50", self._elsewhere)
        return code + self._counted(room, count + constant(I64, 1) + _SUB) + constant(I32, 0)

    def _clear(self, node: nodes.Call) -> bytes:
        room, code, _ = self._opened(node)
        return code + self._counted(room, constant(I64, 0)) + constant(I32, 0)

    def _resized(self, node: nodes.Call) -> bytes:
        room, code, (size, _) = self._opened(node)
        count = self._count_in(room)
        more = size + count + _SUB

        def longer() -> bytes:
            code = self._when(size + room.most + _OVER, self._elsewhere)
            code += self._allocated(more + constant(I64, room.size) + b"\x7e")
            code += self._spend(more + constant(I64, 4) + b"\x80") + self._changing(room, size)
            return code + self._behind(room, count) + constant(I32, 0) + self._bytes(room, more) + _FILL

        code += self._when(size + count + _OVER, longer)
        return code + self._counted(room, size) + constant(I32, 0)

    def _put(self, node: nodes.Call) -> bytes:
        room, code, (index, value) = self._opened(node)
        code += self._when(index + self._count_in(room) + _AT_LEAST, self._elsewhere) + self._changing(room)
        return code + self._stored(room, self._behind(room, index), value) + value

    def _erase(self, node: nodes.Call) -> bytes:
        room, code, (first, *rest) = self._opened(node)
        last = rest[0] if rest else first + constant(I64, 1) + _ADD
        count = self._count_in(room)
        code += self._within_span(first, last, count)
        code += self._spend(count + first + _SUB + constant(I64, 64) + b"\x80") + self._changing(room)
        code += self._behind(room, first) + self._behind(room, last)
        code += self._bytes(room, count + last + _SUB) + _COPY
        return code + self._counted(room, count + last + first + _SUB + _SUB) + constant(I32, 0)

    def _insert(self, node: nodes.Call) -> bytes:
        room, code, (at, value, _) = self._opened(node)
        count = self._count_in(room)
        code += self._within_span(at, count, count)
        code += self._when(count + room.most + _AT_LEAST, self._elsewhere)
        code += self._spend(count + constant(I64, 64) + b"\x80")
        code += self._changing(room, count + constant(I64, 1) + _ADD)
        code += self._behind(room, at + constant(I64, 1) + _ADD) + self._behind(room, at)
        code += self._bytes(room, count + at + _SUB) + _COPY
        code += self._stored(room, self._behind(room, at), value)
        return code + self._counted(room, count + constant(I64, 1) + _ADD) + constant(I32, 0)

    def _sort(self, node: nodes.Call) -> bytes:
        room, code, (first, last) = self._opened(node)
        many = last + first + _SUB
        code += self._within_span(first, last, self._count_in(room))
        if room.room > ROOM:
            code += self._when(many + constant(I64, ROOM // room.size) + _OVER, self._elsewhere)
        code += self._spend(many + constant(I64, 64) + many + b"\x79" + _SUB + b"\x7e") + self._changing(room)
        self._brief = False
        call = self._routine(2, sorting, room.element, self._layout.spare())
        code += self._when(self._behind(room, first) + self._behind(room, last) + call, self._elsewhere)
        return code + constant(I32, 0)

    def _reverse(self, node: nodes.Call) -> bytes:
        room, code, (first, last) = self._opened(node)
        code += self._within_span(first, last, self._count_in(room))
        code += self._spend(last + first + _SUB + constant(I64, 4) + b"\x80") + self._changing(room)
        self._brief = False
        return (
            code
            + self._behind(room, first)
            + self._behind(room, last)
            + self._routine(2, reversing, room.size)
        )

    def _within_span(self, first: bytes, last: bytes, count: bytes) -> bytes:
        """The message is left unless 0 <= first <= last <= count."""
        return self._when(first + last + _OVER + last + count + _OVER + b"\x72", self._elsewhere)


OF_VECTORS: Mapping[str, Callable[[Vectors, nodes.Call], bytes]] = MappingProxyType(
    {
        "a_put": Vectors._put,
        "k_erase": Vectors._erase,
        "k_insert": Vectors._insert,
        "k_reverse": Vectors._reverse,
        "k_sort": Vectors._sort,
        "l_append": Vectors._append,
        "l_clear": Vectors._clear,
        "l_pop": Vectors._pop,
        "l_resized": Vectors._resized,
    }
)
"""What writes each function that changes a vector."""


def _is_filled(node: nodes.Expression) -> TypeGuard[nodes.Call]:
    """Whether it is `std::vector<T>(count)` or `std::vector<T>(count, value)`."""
    return isinstance(node, nodes.Call) and node.function in ("l_filled", "e_fill")


def function(made: Sequence[bytes], *code: bytes) -> bytes:
    """A function with so many local variables of types."""
    whole = row(made) + b"".join(code) + END
    return unsigned(len(whole)) + whole


def _here(local: int) -> bytes:
    return b"\x20" + unsigned(local)


def _put(local: int, value: bytes) -> bytes:
    return value + b"\x21" + unsigned(local)


def _moved(size: int, to: bytes, source: bytes) -> bytes:
    """Bring an element as it stands to another place."""
    load, store = MOVES[size]
    return to + source + bytes((load, 0, 0, store, 0, 0))


def sorting(element: Type, room: int) -> bytes:
    """A function of two addresses, between which elements are put into order, equal ones as they were; it returns
    whether there is one that has no order. `room` is where as many have room.

    Runs of one element, of two, of four and so on are merged into the room and copied back.
    """
    machine, size = machine_type(element), struct_size(struct_code(element) or "")
    more = COMPARE[machine][">"] + (machine in (I32, I64) and not is_signed(element))
    first, end, width, low, middle, high, at, to, out = map(_here, range(9))

    def on(local: int, by: bytes) -> bytes:
        return _put(local, _here(local) + by + _PLUS)

    one, length = constant(I32, size), end + first + _MINUS

    def bounded(begin: bytes) -> bytes:
        """So many bytes on, at most where all end."""
        span = begin + width + _PLUS
        return span + end + span + end + b"\x49" + SELECT

    none = (
        _here(9)
        + _here(9)
        + bytes((COMPARE[machine]["!="],))
        + IF
        + NOTHING
        + constant(I32, 1)
        + RETURN
        + END
    )
    known = turns(at + end + _SAME, _put(9, loaded(at, 0, element)), none, on(6, one))
    after = loaded(at, 0, element) + loaded(to, 0, element) + bytes((more,))
    is_second = to + high + b"\x47" + IF + bytes((I32,)) + after + ELSE + constant(I32, 0) + END
    merged = turns(
        at + middle + _SAME,
        is_second + IF + NOTHING + _moved(size, out, to) + on(7, one) + ELSE,
        _moved(size, out, at) + on(6, one) + END,
        on(8, one),
    )
    rest = out + to + high + to + _MINUS + _COPY + on(8, high + to + _MINUS)
    pair = _put(4, bounded(low)) + _put(5, bounded(middle)) + _put(6, low) + _put(7, middle)
    pass_over = turns(low + end + _SAME, pair, merged, rest, _put(3, high))
    return function(
        [unsigned(7) + bytes((I32,)), unsigned(1) + bytes((machine,))],
        _put(6, first) + known if machine in (F32, F64) else b"",
        _put(2, one),
        turns(
            length + width + b"\x4d",
            _put(3, first) + _put(8, constant(I32, room)) + pass_over,
            first + constant(I32, room) + length + _COPY + _put(2, width + width + _PLUS),
        ),
        constant(I32, 0),
    )


def reversing(size: int) -> bytes:
    """A function of two addresses, between which elements of so many bytes are reversed; it returns 0."""
    first, end = map(_here, range(2))
    load, store = MOVES[size]
    machine, one = I64 if size == 8 else I32, constant(I32, size)
    swapped = _put(2, first + bytes((load, 0, 0))) + _moved(size, first, end)
    swapped += end + _here(2) + bytes((store, 0, 0))
    turn = _put(1, end + one + _MINUS) + swapped + _put(0, first + one + _PLUS)
    return function([unsigned(1) + bytes((machine,))], turns(first + end + b"\x4f", turn), constant(I32, 0))


def alike(element: Type) -> bytes:
    """A function of where elements begin and end, and where as many others begin: whether they are the same."""
    machine, size = machine_type(element), constant(I32, struct_size(struct_code(element) or ""))
    at, end, to = map(_here, range(3))
    differs = loaded(at, 0, element) + loaded(to, 0, element) + bytes((COMPARE[machine]["!="],))
    return function(
        [],
        turns(
            at + end + _SAME,
            differs + IF + NOTHING + constant(I32, 0) + RETURN + END,
            _put(0, at + size + _PLUS) + _put(2, to + size + _PLUS),
        ),
        constant(I32, 1),
    )


def _stores(machine: int, size: int) -> int:
    return {F32: 0x38, F64: 0x39}.get(machine, STORE[size])


def made_in(
    function: nodes.Function | nodes.Skipper, shared: Mapping[str, object]
) -> tuple[frozenset[str], frozenset[str]]:
    """The local variables of a function that are given vectors which need a place of their own, and of them those that
    begin elsewhere: what the function is given, and arrays of the message (one that changes has no other name).
    """
    sources: dict[str, list[nodes.Expression]] = {}
    changed, fields = set(), set()
    for node in nodes.walk(function.body):
        if isinstance(node, nodes.Assign) and isinstance(node.type, kinds.Vector):
            sources.setdefault(node.name, []).append(node.value)
        elif isinstance(node, nodes.Call) and node.function in OF_VECTORS:
            changed.add(root_of(node.arguments[0]))
        elif isinstance(node, nodes.ReadValue):
            fields.add(node.name)
    given = frozenset(function.parameters if isinstance(function, nodes.Function) else ())
    own = {name: {""} for name in changed & given}
    begun = set(given)
    for name, values in sources.items():
        named = [value.name for value in values if isinstance(value, nodes.Read)]
        if name not in shared and fields.issuperset(named):
            own[name] = {"" if name in given else root_of(value) for value in values} - fields
            begun |= {name} if named else set()
    made = {
        name for name, roots in own.items() if name in changed or "" in roots or not roots.isdisjoint(shared)
    }
    while more := {name for name, roots in own.items() if not roots.isdisjoint(made)} - made:
        made |= more
    return frozenset(made), frozenset(made & begun)
