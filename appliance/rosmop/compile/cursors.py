"""`v.begin()`, `v.end()` and what takes them: `erase`, `insert`, `std::sort`, `std::reverse`, `std::accumulate`.

A cursor is an index into a vector that is known when the code is compiled; it is no value that a variable holds.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from appliance.rosmop.compile.conversion import convert, number, wrapped
from appliance.rosmop.compile.places import Value
from appliance.rosmop.compile.scope import Scope
from appliance.rosmop.compile.storing import mark, require_place
from appliance.rosmop.positions import Position
from appliance.rosmop.runtime import vectors
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type

FUNCTIONS: dict[str, Callable[..., object]] = {
    "k_erase": vectors.erase,
    "k_insert": vectors.insert,
    "k_sort": vectors.sort,
    "k_reverse": vectors.reverse,
    "k_sum": vectors.accumulate,
}

ALGORITHMS = frozenset({"sort", "reverse", "accumulate"})
"""Functions of `<algorithm>` and `<numeric>` that take a vector from `begin` to `end`."""


@dataclass(frozen=True)
class Cursor(Type):
    """A place in `vector`: before an element, or behind the last."""

    vector: Value

    def __str__(self) -> str:
        return "an iterator"


def moved(operator: str, left: Value, right: Value, position: Position) -> Value | None:
    """`begin + n`, `end - n`, `end - begin`; None if this is none of them."""
    if not isinstance(left.type, Cursor) or operator not in ("+", "-"):
        return None
    if kinds.is_number(right.type):
        code = f"({left.code} {operator} {number(right.code, right.type, kinds.LONG)})"
        return Value(left.type, code, position, pure=left.pure and right.pure)
    if isinstance(right.type, Cursor) and operator == "-":
        return Value(kinds.LONG, f"({left.code} - {right.code})", position, pure=left.pure and right.pure)
    return None


def begin_or_end(base: Value, name: str, position: Position) -> Value:
    """`v.begin()` or `v.end()`."""
    return Value(Cursor(base), "0" if name == "begin" else f"l_len({base.code})", position, pure=base.pure)


def erase(scope: Scope, base: Value, cursors: Sequence[Value], at: tuple[Position, int]) -> Value:
    """`v.erase(place)`, `v.erase(first, last)`."""
    codes = [_index(base, cursor) for cursor in cursors]
    last = codes[1] if len(codes) > 1 else "None"
    return _changed(scope, base, f"k_erase({scope.context}, {base.code}, {codes[0]}, {last}, {at[1]})", at[0])


def insert(scope: Scope, base: Value, arguments: Sequence[Value], at: tuple[Position, int]) -> Value:
    """`v.insert(place, value)`."""
    kind = _vector(base, at[0])
    value = convert(scope, arguments[1], kind.element, at[1])
    width = scope.codecs.width(kind.element)
    place = _index(base, arguments[0])
    return _changed(
        scope, base, f"k_insert({scope.context}, {base.code}, {place}, {value}, {width}, {at[1]})", at[0]
    )


def algorithm(scope: Scope, name: str, values: Sequence[Value], at: tuple[Position, int]) -> Value:
    """`std::sort(first, last)` and its like."""
    position, site = at
    if len(values) < 2 or not isinstance(values[0].type, Cursor):
        raise SpecificationError.at(position, f"`{name}` goes from `v.begin()` to `v.end()`")
    base = values[0].type.vector
    kind = _vector(base, position)
    span = f"{base.code}, {values[0].code}, {_index(base, values[1])}, {site}"
    if name == "accumulate":
        return _sum(scope, values, span, at)
    if len(values) != 2:
        raise SpecificationError.at(values[2].position, f"`{name}` with a function of one's own is not known")
    if name == "sort" and not kinds.is_scalar(kind.element):
        raise SpecificationError.at(position, f"a {kind} has no order to sort by")
    return _changed(scope, base, f"k_{name}({scope.context}, {span})", position)


def _sum(scope: Scope, values: Sequence[Value], span: str, at: tuple[Position, int]) -> Value:
    if len(values) != 3 or not kinds.is_number(values[2].type):
        raise SpecificationError.at(
            at[0], "`accumulate` goes from `v.begin()` to `v.end()`, with a number to start from"
        )
    kind = values[2].type
    assert isinstance(values[0].type, Cursor)  # the caller has looked
    element = _vector(values[0].type.vector, at[0]).element
    if not kinds.is_number(element):
        raise SpecificationError.at(at[0], f"{element} has no sum")
    wide = kinds.common(kind, element)
    added = f"{number('a', kind, wide)} + {number('e', element, wide)}"
    result = wrapped(added, wide) if isinstance(wide, kinds.Integer) else f"({added})"
    step = f"lambda a, e: {number(result, wide, kind)}"
    return Value(kind, f"k_sum({scope.context}, {span}, {values[2].code}, {step})", at[0])


def _vector(base: Value, position: Position) -> kinds.Vector:
    if not isinstance(base.type, kinds.Vector):
        raise SpecificationError.at(position, f"{base.type} has no elements")
    return base.type


def _index(base: Value, cursor: Value) -> str:
    if not isinstance(cursor.type, Cursor) or cursor.type.vector.code != base.code:
        raise SpecificationError.at(cursor.position, "write `v.begin() + n` of the same vector")
    return cursor.code


def _changed(scope: Scope, base: Value, code: str, position: Position) -> Value:
    require_place(base, "this")
    flag = mark(scope, base)
    return Value(kinds.VOID, f"(({flag} := True), {code})[1]" if flag else code, position, pure=False)
