"""Compile `v.begin()`, `v.end()` and the functions that take them: `erase`, `insert`, `std::sort`, and others.

A cursor is an index into a vector that is known at compile time; a variable cannot hold a cursor.
"""

from collections.abc import Sequence

from rosmop.check.assignables import Value
from rosmop.check.assignments import mark, require_place, with_mark
from rosmop.check.conversion import convert, number
from rosmop.check.scope import FunctionScope
from rosmop.form import nodes
from rosmop.form.findings import Position, SpecificationError
from rosmop.types import value_types

ALGORITHMS = frozenset({"sort", "reverse", "accumulate"})


def move(operator: str, left: Value, right: Value, position: Position) -> Value | None:
    """Return the value of `begin + n`, `end - n` or `end - begin`, and None for other operations."""
    if left.vector is None or operator not in ("+", "-"):
        return None
    if value_types.is_number(right.type):
        function, distance = (
            "k_after" if operator == "+" else "k_before",
            number(right.form, value_types.LONG),
        )
        return Value(
            nodes.Call(value_types.INDEX, function, (left.form, distance)), position, vector=left.vector
        )
    if right.vector is not None and operator == "-":
        return Value(nodes.Call(value_types.LONG, "k_before", (left.form, right.form)), position)
    return None


def begin_or_end(base: Value, name: str, position: Position) -> Value:
    begin = nodes.Literal(value_types.INDEX, 0)
    place = begin if name == "begin" else nodes.Call(value_types.INDEX, "l_len", (base.form,))
    return Value(place, position, vector=base)


def erase(scope: FunctionScope, base: Value, cursors: Sequence[Value], at: tuple[Position, int]) -> Value:
    first, last = _index(base, cursors[0]), nodes.Literal(value_types.VOID, None)
    arguments = (base.form, first, _index(base, cursors[1]) if len(cursors) > 1 else last)
    return _change(scope, base, nodes.Call(value_types.VOID, "k_erase", arguments, at[1]), at[0])


def insert(scope: FunctionScope, base: Value, arguments: Sequence[Value], at: tuple[Position, int]) -> Value:
    kind = _vector(base, at[0])
    value = convert(scope, arguments[1], kind.element, at[1])
    width = nodes.Literal(value_types.ULONG, scope.values.width(kind.element))
    handed = (base.form, _index(base, arguments[0]), value, width)
    return _change(scope, base, nodes.Call(value_types.VOID, "k_insert", handed, at[1]), at[0])


def algorithm(scope: FunctionScope, name: str, values: Sequence[Value], at: tuple[Position, int]) -> Value:
    position, site = at
    if len(values) < 2 or values[0].vector is None:
        raise SpecificationError.at(position, f"`{name}` goes from `v.begin()` to `v.end()`")
    base = values[0].vector
    kind = _vector(base, position)
    span = (base.form, values[0].form, _index(base, values[1]))
    if name == "accumulate":
        return _sum(values, span, at)
    if len(values) != 2:
        raise SpecificationError.at(
            values[2].position, f"`{name}` with a comparison function is not supported"
        )
    if name == "sort" and not value_types.is_scalar(kind.element):
        raise SpecificationError.at(position, f"a {kind} has no order to sort by")
    return _change(scope, base, nodes.Call(value_types.VOID, f"k_{name}", span, site), position)


def _sum(
    values: Sequence[Value],
    span: tuple[nodes.Expression, nodes.Expression, nodes.Expression],
    at: tuple[Position, int],
) -> Value:
    if len(values) != 3 or not value_types.is_number(values[2].type):
        raise SpecificationError.at(
            at[0], "`accumulate` goes from `v.begin()` to `v.end()`, with a number to start from"
        )
    kind = values[2].type
    assert values[0].vector is not None  # the caller checks this
    element = _vector(values[0].vector, at[0]).element
    if not value_types.is_number(element):
        raise SpecificationError.at(at[0], f"{element} has no sum")
    wide = value_types.common(kind, element)
    return Value(nodes.Accumulate(kind, *span, values[2].form, wide, at[1]), at[0])


def _vector(base: Value, position: Position) -> value_types.VectorType:
    if not isinstance(base.type, value_types.VectorType):
        raise SpecificationError.at(position, f"{base.type} has no elements")
    return base.type


def _index(base: Value, cursor: Value) -> nodes.Expression:
    if cursor.vector is None or cursor.vector.form != base.form:
        raise SpecificationError.at(cursor.position, "write `v.begin() + n` of the same vector")
    return cursor.form


def _change(scope: FunctionScope, base: Value, change: nodes.Expression, position: Position) -> Value:
    require_place(base, "this")
    return Value(with_mark(mark(scope, base), change), position)
