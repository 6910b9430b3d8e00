"""The layout of a module's memory (see `abi.py`), and the sizes of values there."""

from collections.abc import Mapping, Sequence

from rosmop.fast.abi import ARENA, FIRST, SENDER, Cells, is_kept
from rosmop.fast.deferred_output import OutputLine
from rosmop.fast.wasm import F32, F64, I32, I64
from rosmop.form import nodes
from rosmop.runtime.values import ValueCodec, struct_code, struct_size
from rosmop.types import value_types
from rosmop.types.value_types import Type

LINES = 64 << 10
"""The bytes for lines of output. A message whose line does not fit is left."""


class NotCompiledError(Exception):
    """A function or a node that cannot be compiled. The site is -1 for the whole function."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason
        self.site = -1

    @classmethod
    def of(cls, kind: Type) -> "NotCompiledError":
        return cls(f"makes, keeps, compares or changes a value of type {kind}")

    def place(self, site: int) -> None:
        if self.site < 0:
            self.site = site


def reason_of(error: NotCompiledError | RecursionError) -> NotCompiledError:
    return (
        error if isinstance(error, NotCompiledError) else NotCompiledError("has expressions nested too deep")
    )


def machine_type(kind: Type) -> int:
    if isinstance(kind, value_types.BoolType) or (
        isinstance(kind, value_types.IntegerType) and kind.bits <= 32
    ):
        return I32
    if isinstance(
        kind,
        value_types.IntegerType | value_types.TimeType | value_types.DurationType | value_types.IteratorType,
    ):
        return I64
    if isinstance(kind, value_types.FloatingType):
        return F32 if kind.bits == 32 else F64
    raise NotCompiledError.of(kind)


def is_signed(kind: Type) -> bool:
    return not isinstance(kind, value_types.IntegerType) or kind.signed


class MemoryLayout:
    """Allocates the memory of a module."""

    def __init__(
        self, functions: Mapping[str, nodes.Function], shared: Mapping[str, Cells], values: ValueCodec
    ) -> None:
        self._values = values
        self.functions = functions
        self.shared = shared
        self.budgets: dict[str, int] = {}
        self.throttles: dict[tuple[str, int], int] = {}
        self.senders: dict[str, int] = {}
        self.constants: dict[bytes, int] = {}
        self.strings: set[bytes] = set()
        self.references: list[range] = []
        self.lines: list[OutputLine] = []
        self.changed = {
            node.arguments[0].name
            for function in functions.values()
            for node in nodes.walk(function.body)
            if isinstance(node, nodes.Call)
            and node.function == "a_put"
            and isinstance(node.arguments[0], nodes.Read)
        }
        """The arrays of which an element is assigned."""
        self._used = FIRST
        self._arena = 0
        self.said = self.take(LINES)

    def variable(self, name: str, kind: Type) -> int:
        cells = self.shared[name]
        if not is_kept(kind):
            machine_type(kind)
        place = cells.base + 8 * (cells.properties + len(cells.variables))
        return cells.variables.setdefault(name, (place, kind))[0]

    def size(self, kind: Type) -> int:
        """Return the size of values of this type in a message. Raises `NotCompiledError` if it varies."""
        code = struct_code(kind)
        if code is not None:
            return struct_size(code)
        if isinstance(kind, value_types.RecordType):
            return sum(map(self.size, self._values.fields(kind)))
        if isinstance(kind, value_types.VectorType) and kind.length is not None:
            return kind.length * self.size(kind.element)
        raise NotCompiledError.of(kind)

    def least(self, kind: Type) -> int:
        return self._values.least(kind)

    def fields(self, kind: Type) -> Sequence[Type]:
        if not isinstance(kind, value_types.RecordType):
            raise NotCompiledError.of(kind)
        return self._values.fields(kind)

    def varies(self, kind: Type) -> bool:
        try:
            self.size(kind)
        except NotCompiledError:
            return True
        return False

    def row(self, kind: Type) -> int:
        """Return the bytes of a message of variable size in a table: its address, and the ends of such fields.

        Before the end of a field that is a message itself comes the row of this message.
        """
        varying = [field for field in self.fields(kind) if self.varies(field)]
        inner = [self.row(field) for field in varying if isinstance(field, value_types.RecordType)]
        return 4 + 4 * len(varying) + sum(inner)

    def place_of_field(self, kind: Type, number: int) -> tuple[int | None, int]:
        """Return where the address of a field is: the offset in the row of a word, or None, and what to add to it.

        A field that is a message of variable size is its row.
        """
        if not self.varies(kind):
            return None, sum(map(self.size, self.fields(kind)[:number]))
        base, distance, word = 0, 0, 4
        for field in self.fields(kind)[:number]:
            if not self.varies(field):
                distance += self.size(field)
                continue
            base, distance = word + (self.row(field) if isinstance(field, value_types.RecordType) else 0), 0
            word = base + 4
        field = self.fields(kind)[number]
        is_row = isinstance(field, value_types.RecordType) and self.varies(field)
        return (None, word) if is_row else (base, distance)

    def element(self, kind: Type) -> tuple[Type, int]:
        """Return the type of the elements, and their distance in bytes: in a table, if their size varies."""
        if isinstance(kind, value_types.StringType):
            return value_types.UINT8, 1
        if not isinstance(kind, value_types.VectorType):
            raise NotCompiledError.of(kind)
        if isinstance(kind.element, value_types.StringType):
            return kind.element, 4
        if isinstance(kind.element, value_types.RecordType) and self.varies(kind.element):
            return kind.element, self.row(kind.element)
        return kind.element, self.size(kind.element)

    def require_free_copy(self, kind: Type) -> Type:
        """Return the type. Raises `NotCompiledError` if a copy of its values is not free."""
        if isinstance(kind, value_types.RecordType):
            for field in self._values.fields(kind):
                self.require_free_copy(field)
        elif struct_code(kind) is None:
            raise NotCompiledError.of(kind)
        return kind

    def take(self, size: int) -> int:
        at = self._used
        self._used += -(-size // 8) * 8
        return at

    def arena(self) -> int:
        self._arena = self._arena or self.take(ARENA)
        return self._arena

    @property
    def has_arena(self) -> bool:
        return self._arena > 0

    def reference(self) -> int:
        at = self.take(8)
        self.references.append(range(at, at + 8))
        return at

    def constant(self, raw: bytes) -> int:
        if raw not in self.constants:
            self.constants[raw] = self.take(len(raw))
        return self.constants[raw]

    def budget(self, context: str) -> int:
        if context not in self.budgets:
            self.budgets[context] = self.take(8)
        return self.budgets[context]

    def sender(self, context: str) -> int:
        if context not in self.senders:
            self.senders[context] = self.take(SENDER)
        return self.senders[context]

    def throttle(self, context: str, site: int) -> int:
        if (context, site) not in self.throttles:
            self.throttles[context, site] = self.take(8)
        return self.throttles[context, site]
