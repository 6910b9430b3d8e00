"""Compile calls of member functions."""

from collections.abc import Callable, Sequence

from rosmop.check.assignables import Value
from rosmop.check.assignments import mark, require_place, store, with_mark
from rosmop.check.conversion import convert, number
from rosmop.check.scope import FunctionScope
from rosmop.form import nodes
from rosmop.form.findings import Position, SpecificationError
from rosmop.types import value_types


class MemberCall:
    """A call of a member function during compilation."""

    def __init__(
        self,
        scope: FunctionScope,
        base: Value,
        name: str,
        arguments: Sequence[Value],
        at: tuple[Position, int],
    ) -> None:
        self.scope = scope
        self.base = base
        self.name = name
        self.arguments = arguments
        self.position, self.site = at

    def count(self, least: int, most: int | None = None) -> int:
        number_of = len(self.arguments)
        if not least <= number_of <= (least if most is None else most):
            wanted = str(least) if most in (None, least) else f"{least} to {most}"
            raise SpecificationError.at(
                self.position, f"`{self.name}` takes {wanted} argument(s), not {number_of}"
            )
        return number_of

    def index(self, position: int, default: int | None = None) -> nodes.Expression:
        if default is not None and position >= len(self.arguments):
            return nodes.Literal(value_types.ULONG, default)
        value = self.arguments[position]
        if not value_types.is_number(value.type):
            raise SpecificationError.at(value.position, f"`{self.name}` needs a number; this is {value.type}")
        return number(value.form, value_types.ULONG)

    def text(self, position: int) -> nodes.Expression:
        value = self.arguments[position]
        if value.type == value_types.CHAR:
            return nodes.Call(value_types.STRING, "t_byte", (value.form,))
        return convert(self.scope, value, value_types.STRING)

    def call(self, kind: value_types.Type, function: str, *arguments: nodes.Expression) -> nodes.Call:
        return nodes.Call(kind, function, (self.base.form, *arguments), self.site)

    def value(self, kind: value_types.Type, function: str, *arguments: nodes.Expression) -> Value:
        return Value(self.call(kind, function, *arguments), self.position)

    def changes(self, value: nodes.Expression) -> Value:
        require_place(self.base, f"`{self.name}`")
        stored = store(self.scope, self.base, value)
        return Value(nodes.Discard(stored), self.position)

    def changes_in_place(self, function: str, *arguments: nodes.Expression) -> Value:
        require_place(self.base, f"`{self.name}`")
        if isinstance(self.base.type, value_types.VectorType) and self.base.type.length is not None:
            raise SpecificationError.at(
                self.position, f"`{self.name}`: an array of fixed length cannot change its length"
            )
        change = with_mark(mark(self.scope, self.base), self.call(value_types.VOID, function, *arguments))
        return Value(change, self.position)


Method = Callable[[MemberCall], Value]


def length(call: MemberCall) -> Value:
    call.count(0)
    return call.value(value_types.ULONG, "l_len")


def empty(call: MemberCall) -> Value:
    call.count(0)
    return call.value(value_types.BOOL, "l_empty")
