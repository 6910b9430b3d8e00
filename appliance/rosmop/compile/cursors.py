"""`v.begin()`, `v.end()` and what takes them: `erase`, `insert`, `std::sort`, `std::reverse`, `std::accumulate`.

A cursor is an index into a vector that is known when the code is compiled; it is no value that a variable holds.
"""

from collections.abc import Sequence

from appliance.rosmop.compile.assignments import mark, marked, require_place
from appliance.rosmop.compile.conversion import convert, number
from appliance.rosmop.compile.places import Value
from appliance.rosmop.compile.scope import Scope
from appliance.rosmop.ir import form
from appliance.rosmop.positions import Position
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.types import kinds

ALGORITHMS = frozenset({"sort", "reverse", "accumulate"})
"""Functions of `<algorithm>` and `<numeric>` that take a vector from `begin` to `end`."""


def moved(operator: str, left: Value, right: Value, position: Position) -> Value | None:
    """`begin + n`, `end - n`, `end - begin`; None if this is none of them."""
    if left.vector is None or operator not in ("+", "-"):
        return None
    if kinds.is_number(right.type):
        function, distance = "k_after" if operator == "+" else "k_before", number(right.form, kinds.LONG)
        return Value(form.Call(kinds.INDEX, function, (left.form, distance)), position, vector=left.vector)
    if right.vector is not None and operator == "-":
        return Value(form.Call(kinds.LONG, "k_before", (left.form, right.form)), position)
    return None


def begin_or_end(base: Value, name: str, position: Position) -> Value:
    """`v.begin()` or `v.end()`."""
    begin = form.Literal(kinds.INDEX, 0)
    place = begin if name == "begin" else form.Call(kinds.INDEX, "l_len", (base.form,))
    return Value(place, position, vector=base)


def erase(scope: Scope, base: Value, cursors: Sequence[Value], at: tuple[Position, int]) -> Value:
    """`v.erase(place)`, `v.erase(first, last)`."""
    first, last = _index(base, cursors[0]), form.Literal(kinds.VOID, None)
    arguments = (base.form, first, _index(base, cursors[1]) if len(cursors) > 1 else last)
    return _changed(scope, base, form.Call(kinds.VOID, "k_erase", arguments, at[1]), at[0])


def insert(scope: Scope, base: Value, arguments: Sequence[Value], at: tuple[Position, int]) -> Value:
    """`v.insert(place, value)`."""
    kind = _vector(base, at[0])
    value = convert(scope, arguments[1], kind.element, at[1])
    width = form.Literal(kinds.ULONG, scope.values.width(kind.element))
    handed = (base.form, _index(base, arguments[0]), value, width)
    return _changed(scope, base, form.Call(kinds.VOID, "k_insert", handed, at[1]), at[0])


def algorithm(scope: Scope, name: str, values: Sequence[Value], at: tuple[Position, int]) -> Value:
    """`std::sort(first, last)` and its like."""
    position, site = at
    if len(values) < 2 or values[0].vector is None:
        raise SpecificationError.at(position, f"`{name}` goes from `v.begin()` to `v.end()`")
    base = values[0].vector
    kind = _vector(base, position)
    span = (base.form, values[0].form, _index(base, values[1]))
    if name == "accumulate":
        return _sum(values, span, at)
    if len(values) != 2:
        raise SpecificationError.at(values[2].position, f"`{name}` with a function of one's own is not known")
    if name == "sort" and not kinds.is_scalar(kind.element):
        raise SpecificationError.at(position, f"a {kind} has no order to sort by")
    return _changed(scope, base, form.Call(kinds.VOID, f"k_{name}", span, site), position)


def _sum(
    values: Sequence[Value],
    span: tuple[form.Expression, form.Expression, form.Expression],
    at: tuple[Position, int],
) -> Value:
    if len(values) != 3 or not kinds.is_number(values[2].type):
        raise SpecificationError.at(
            at[0], "`accumulate` goes from `v.begin()` to `v.end()`, with a number to start from"
        )
    kind = values[2].type
    assert values[0].vector is not None  # the caller has looked
    element = _vector(values[0].vector, at[0]).element
    if not kinds.is_number(element):
        raise SpecificationError.at(at[0], f"{element} has no sum")
    wide = kinds.common(kind, element)
    return Value(form.Accumulate(kind, *span, values[2].form, wide, at[1]), at[0])


def _vector(base: Value, position: Position) -> kinds.Vector:
    if not isinstance(base.type, kinds.Vector):
        raise SpecificationError.at(position, f"{base.type} has no elements")
    return base.type


def _index(base: Value, cursor: Value) -> form.Expression:
    if cursor.vector is None or cursor.vector.form != base.form:
        raise SpecificationError.at(cursor.position, "write `v.begin() + n` of the same vector")
    return cursor.form


def _changed(scope: Scope, base: Value, change: form.Expression, position: Position) -> Value:
    require_place(base, "this")
    return Value(marked(mark(scope, base), change), position)
