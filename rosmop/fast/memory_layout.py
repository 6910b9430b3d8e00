"""What stands where in the memory of a module, and how large the values of a type are there. See `abi.py`."""

from collections.abc import Mapping

from rosmop.fast.abi import FIRST, Cells
from rosmop.fast.deferred_output import Line
from rosmop.fast.wasm import F32, F64, I32, I64
from rosmop.form import nodes
from rosmop.runtime.values import Values, struct_code, struct_size
from rosmop.types import value_types
from rosmop.types.value_types import Type

LINES = 64 << 10
"""Bytes for lines of output; a message whose line has no room is left."""


class NotScalarError(Exception):
    """A function has something that this part of the form does not have."""


def machine_type(kind: Type) -> int:
    """The type of the machine for one of the language. Raises `NotScalarError`."""
    if isinstance(kind, value_types.Bool) or (isinstance(kind, value_types.Integer) and kind.bits <= 32):
        return I32
    if isinstance(kind, value_types.Integer | value_types.Time | value_types.Duration | value_types.Index):
        return I64
    if isinstance(kind, value_types.Floating):
        return F32 if kind.bits == 32 else F64
    raise NotScalarError(str(kind))


def is_signed(kind: Type) -> bool:
    """Whether numbers of the type may be negative."""
    return not isinstance(kind, value_types.Integer) or kind.signed


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
        self.references: list[range] = []
        """Where functions leave the values of their references."""
        self.lines: list[Line] = []
        self._used = FIRST
        self.said = self.take(LINES)
        """Where lines stand."""

    def variable(self, name: str, kind: Type) -> int:
        """Where a variable of the set stands."""
        cells = self.shared[name]
        if not isinstance(kind, value_types.String):
            machine_type(kind)
        place = cells.base + 8 * (cells.properties + len(cells.variables))
        return cells.variables.setdefault(name, (place, kind))[0]

    def size(self, kind: Type) -> int:
        """The bytes of every value of a type in a message. Raises `NotScalarError` where they differ."""
        code = struct_code(kind)
        if code is not None:
            return struct_size(code)
        if isinstance(kind, value_types.Record):
            return sum(map(self.size, self._values.fields(kind)))
        if isinstance(kind, value_types.Vector) and kind.length is not None:
            return kind.length * self.size(kind.element)
        raise NotScalarError(str(kind))

    def offset(self, kind: Type, number: int) -> int:
        """Where a field of a message begins in it. Raises `NotScalarError` where that differs."""
        if not isinstance(kind, value_types.Record):
            raise NotScalarError(str(kind))
        return sum(map(self.size, self._values.fields(kind)[:number]))

    def element(self, kind: Type) -> tuple[Type, int]:
        """The type of the elements of a string or vector, and the bytes from one to the next (strings: in the table).

        Raises `NotScalarError`.
        """
        if isinstance(kind, value_types.String):
            return value_types.UINT8, 1
        if not isinstance(kind, value_types.Vector):
            raise NotScalarError(str(kind))
        return kind.element, 4 if isinstance(kind.element, value_types.String) else self.size(kind.element)

    def copied(self, kind: Type) -> Type:
        """A message whose copy costs nothing. Raises `NotScalarError` of another."""
        if isinstance(kind, value_types.Record):
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

    def reference(self) -> int:
        """The address of memory for the value of a reference."""
        at = self.take(8)
        self.references.append(range(at, at + 8))
        return at

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
