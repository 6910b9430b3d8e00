"""What stands where in the memory of a module, and how large the values of a type are there. See `abi.py`."""

from collections.abc import Iterator, Mapping

from rosmop.fast.abi import FIRST, ROOM, Cells
from rosmop.fast.deferred_output import Line, Publication
from rosmop.fast.wasm import F32, F64, I32, I64
from rosmop.form import nodes
from rosmop.runtime.values import Values, is_array, struct_code, struct_size
from rosmop.types import kinds
from rosmop.types.kinds import Type

LINES = 64 << 10
"""Bytes for lines of output and messages that are published; a message whose line has no room is left."""

MOST_MADE = 1024
"""Bytes of a message that is made or kept here, without what its strings have."""

HEAP = 512 << 10
"""Bytes for the elements of arrays of any length in messages that are made or kept while a read is walked over."""

MAX_ROOMS = 16 << 20
"""Bytes that all vectors of a set may take."""


class NotScalarError(Exception):
    """A function has something that this part of the form does not have."""


def machine_type(kind: Type) -> int:
    """The type of the machine for one of the language. Raises `NotScalarError`."""
    if isinstance(kind, kinds.Bool) or (isinstance(kind, kinds.Integer) and kind.bits <= 32):
        return I32
    if isinstance(kind, kinds.Integer | kinds.Time | kinds.Duration | kinds.Index):
        return I64
    if isinstance(kind, kinds.Floating):
        return F32 if kind.bits == 32 else F64
    raise NotScalarError(str(kind))


def is_signed(kind: Type) -> bool:
    """Whether numbers of the type may be negative."""
    return not isinstance(kind, kinds.Integer) or kind.signed


class Layout:
    """Gives out the memory of a module."""

    def __init__(
        self, functions: Mapping[str, nodes.Function], shared: Mapping[str, Cells], values: Values
    ) -> None:
        self._values = values
        self.functions = functions
        self.shared = shared
        self.budgets: dict[str, int] = {}
        self.throttles: dict[tuple[str, int], int] = {}
        """Where it stands when output at a site of a specification was last due."""
        self.constants: dict[bytes, int] = {}
        """Where bytes stand from the beginning."""
        self.strings: set[bytes] = set()
        """Those of them that are strings."""
        self.arrays_at: dict[int, int] = {}
        """The bytes of an element of the arrays of any length that are kept, by where each is noted."""
        self.rooms: list[range] = []
        """Where vectors stand."""
        self.lines: list[Line | Publication] = []
        self.publications: dict[tuple[str, str], int] = {}
        """Where it stands (i64) whether what a specification publishes on a topic is only counted."""
        self.places: list[range] = []
        """Where messages stand that are made or kept here, and whether what is published is only counted."""
        self._used = FIRST
        self._spare = self._heap = 0
        self.said = self.take(LINES)
        """Where lines stand."""

    def variable(self, name: str, kind: Type) -> int:
        """Where a variable of the set stands."""
        cells = self.shared[name]
        if not isinstance(kind, kinds.String | kinds.Vector):
            machine_type(kind)
        place = cells.base + 8 * (cells.properties + len(cells.variables))
        return cells.variables.setdefault(name, (place, kind))[0]

    def size(self, kind: Type) -> int:
        """The bytes of every value of a type in a message. Raises `NotScalarError` where they differ."""
        code = struct_code(kind)
        if code is not None:
            return struct_size(code)
        if isinstance(kind, kinds.Record):
            return sum(map(self.size, self._values.fields(kind)))
        if isinstance(kind, kinds.Vector) and kind.length is not None:
            return kind.length * self.size(kind.element)
        raise NotScalarError(str(kind))

    def field(self, kind: Type, number: int) -> Type:
        """The type of a field of a message."""
        if not isinstance(kind, kinds.Record):
            raise NotScalarError(str(kind))
        return self._values.fields(kind)[number]

    def offset(self, kind: Type, number: int) -> int:
        """Where a field of a message begins in it. Raises `NotScalarError` where that differs."""
        if not isinstance(kind, kinds.Record):
            raise NotScalarError(str(kind))
        return sum(map(self.extent, self._values.fields(kind)[:number]))

    def extent(self, kind: Type) -> int:
        """The same of one that is made here, where a string is 8 bytes: where it is and how long."""
        if isinstance(kind, kinds.Record):
            return sum(map(self.extent, self._values.fields(kind)))
        return 8 if isinstance(kind, kinds.String) or is_array(kind) else self.size(kind)

    def leaves(self, kind: Type, at: int = 0) -> Iterator[tuple[int, Type]]:
        """The numbers, times, strings and arrays of any length of one that is made here, and where each stands."""
        parts = self._values.fields(kind) if isinstance(kind, kinds.Record) else ()
        if isinstance(kind, kinds.Vector):
            parts = [kind.element] * (kind.length or 0)
        if is_array(kind) or not isinstance(kind, kinds.Record | kinds.Vector):
            yield at, kind
        for part in parts:
            yield from self.leaves(part, at)
            at += self.extent(part)

    def arrays(self, kind: Type) -> Iterator[int]:
        """The bytes that a copy is charged for: those of each array of fixed length in a message."""
        parts = self._values.fields(kind) if isinstance(kind, kinds.Record) else ()
        if isinstance(kind, kinds.Vector) and kind.length is not None:
            yield kind.length * self._values.width(kind.element)
            parts = [kind.element] * kind.length
        for part in parts:
            yield from self.arrays(part)

    def made(self, kind: Type) -> int:
        """Where a message is made. Raises `NotScalarError` of one of any size, or a large one."""
        size = self.extent(kind)
        if size > MOST_MADE:
            raise NotScalarError(f"{kind} of {size} bytes")
        at = self.take(size)
        self.places.append(range(at, at + -(-size // 8) * 8))
        return at

    def record(self, name: str, kind: Type) -> int:
        """Where a variable of the set stands that is a message."""
        cells = self.shared[name]
        if name not in cells.records:
            if not isinstance(kind, kinds.Record):
                raise NotScalarError(str(kind))
            begin = self.made(kind)
            inner = {begin + at: leaf for at, leaf in self.leaves(kind) if not struct_code(leaf)}
            places = {at: self.room(2 * ROOM) for at, leaf in inner.items() if is_array(leaf)}
            self.arrays_at |= {at: self.element(inner[at])[1] for at in places}
            cells.texts |= places
            cells.records[name] = (begin, kind)
            cells.inner[name] = [*inner]
            cells.sizes[name] = len(self.places[-1])
            cells.known[name] = self.take(8)
            self.places.append(range(cells.known[name], cells.known[name] + 8))
        return cells.records[name][0]

    def publication(self, context: str, topic: str) -> int:
        """Where it stands whether what a specification publishes on a topic is only counted."""
        if (context, topic) not in self.publications:
            at = self.publications[context, topic] = self.take(8)
            self.places.append(range(at, at + 8))
        return self.publications[context, topic]

    def element(self, kind: Type) -> tuple[Type, int]:
        """The type of the elements of a string or vector, and the bytes from one to the next (strings: in the table).

        Raises `NotScalarError`.
        """
        if isinstance(kind, kinds.String):
            return kinds.UINT8, 1
        if not isinstance(kind, kinds.Vector):
            raise NotScalarError(str(kind))
        return kind.element, 4 if isinstance(kind.element, kinds.String) else self.size(kind.element)

    def copied(self, kind: Type) -> Type:
        """A message whose copy costs nothing. Raises `NotScalarError` of another."""
        if isinstance(kind, kinds.Record):
            for field in self._values.fields(kind):
                self.copied(field)
        elif struct_code(kind) is None:
            raise NotScalarError(str(kind))
        return kind

    def take(self, size: int) -> int:
        """The address of so many bytes of memory."""
        at = self._used
        self._used += -(-size // 8) * 8
        return at

    def room(self, size: int) -> int:
        """The address of memory for a vector. Raises `NotScalarError` if all have too much."""
        if size + sum(map(len, self.rooms)) > MAX_ROOMS:
            raise NotScalarError("many vectors")
        at = self.take(size)
        self.rooms.append(range(at, at + size))
        return at

    def spare(self) -> int:
        """The address of memory for a vector that nothing is kept in."""
        self._spare = self._spare or self.room(ROOM)
        return self._spare

    def heap(self) -> int:
        """Where it stands (i32) where what is next has room for elements of arrays, and (behind it) from where on
        elements may change; then come `HEAP` bytes for them.
        """
        self._heap = self._heap or self.room(8 + HEAP)
        return self._heap

    @property
    def has_heap(self) -> bool:
        """Whether anything has asked for it."""
        return self._heap > 0

    def constant(self, raw: bytes) -> int:
        """Where these bytes stand from the beginning."""
        if raw not in self.constants:
            self.constants[raw] = self.take(len(raw))
        return self.constants[raw]

    def budget(self, context: str) -> int:
        """Where the budget of a specification stands."""
        if context not in self.budgets:
            self.budgets[context] = self.take(8)
        return self.budgets[context]

    def throttle(self, context: str, site: int) -> int:
        """Where it stands when output at a site was last due."""
        if (context, site) not in self.throttles:
            self.throttles[context, site] = self.take(8)
        return self.throttles[context, site]
