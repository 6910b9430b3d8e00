"""Keep the order of evaluation of C++17 by storing values in variables first.

The form is evaluated from left to right. In an assignment the right side comes first, then the indices on the left;
in a member call the object, then the arguments. References and members are read after all arguments. Where C++ leaves
the order open, any order is correct.
"""

from collections.abc import Sequence
from dataclasses import replace

from rosmop.check.assignables import (
    CharacterLvalue,
    ElementLvalue,
    FieldLvalue,
    Lvalue,
    TimePartLvalue,
    Value,
    VariableLvalue,
)
from rosmop.check.scope import FunctionScope
from rosmop.form import nodes
from rosmop.types import value_types
from rosmop.types.value_types import Type

First = list[nodes.Expression]


def after(first: Sequence[nodes.Expression], value: Value) -> Value:
    if not first:
        return value
    whole = nodes.Sequence(value.type, (*first, value.form), -1)
    return replace(value, form=whole, first=(*first, *value.first))


def keep(scope: FunctionScope, value: nodes.Expression) -> tuple[First, nodes.Expression]:
    if isinstance(value, nodes.Literal):
        return [], value
    name = scope.temporary()
    return [nodes.Assign(value.type, name, value)], nodes.Read(value.type, name)


def settle(scope: FunctionScope, value: Value) -> tuple[First, Value]:
    place = value.place
    if place is None:
        first, read = keep(scope, value.form)
        return first, replace(value, form=read, first=())
    if isinstance(place, VariableLvalue):
        return [], value
    assert isinstance(
        place, ElementLvalue | CharacterLvalue | FieldLvalue | TimePartLvalue
    )  # the other kinds
    first, base = settle(scope, place.base)
    settled_place: Lvalue = replace(place, base=base)
    if isinstance(place, ElementLvalue | CharacterLvalue):
        indexed, index = keep(scope, place.index)
        first += indexed
        settled_place = replace(place, base=base, index=index)
    read = _read(value.type, settled_place)
    return [*value.first, *first], replace(value, form=read, place=settled_place, first=())


def _read(kind: Type, lvalue: Lvalue) -> nodes.Expression:
    if isinstance(lvalue, ElementLvalue):
        return nodes.Call(kind, "l_element", (lvalue.base.form, lvalue.index), lvalue.site)
    if isinstance(lvalue, CharacterLvalue):
        return nodes.Call(kind, "e_character", (lvalue.base.form, lvalue.index), lvalue.site)
    if isinstance(lvalue, FieldLvalue):
        return nodes.Item(kind, lvalue.base.form, lvalue.slot)
    assert isinstance(lvalue, TimePartLvalue)  # the last kind
    return nodes.Call(kind, f"m_{lvalue.part}", (lvalue.base.form,))


def arguments(scope: FunctionScope, values: Sequence[Value]) -> tuple[First, list[Value]]:
    if sum(not isinstance(value.form, nodes.Literal) for value in values) < 2:
        return [], list(values)
    return _in_turn(scope, values)


def _in_turn(scope: FunctionScope, values: Sequence[Value]) -> tuple[First, list[Value]]:
    each = [([], value) if value.pure else settle(scope, value) for value in values]
    return [before for first, _ in each for before in first], [value for _, value in each]


def of_member(scope: FunctionScope, base: Value, values: Sequence[Value]) -> tuple[First, Value, list[Value]]:
    if all(value.pure for value in values) and (base.pure or base.place is None):
        return [], base, list(values)
    first, base = ([], base) if base.pure and base.place is None else settle(scope, base)
    before, ordered = _in_turn(scope, values)
    return [*first, *before], base, ordered


def _is_variable(target: Value) -> bool:
    return isinstance(target.place, VariableLvalue) and target.place.variable.alias is None


def of_change(scope: FunctionScope, target: Value, value: Value) -> tuple[First, Value, Value]:
    """Return a target and a value that are both read after all indices are known."""
    if target.pure and value.pure:
        return [], target, value
    if value_types.is_number(value.type):  # for a class, only the place is evaluated first
        value = replace(value, place=None)
    first, value = settle(scope, value)
    before, target = ([], target) if target.pure else settle(scope, target)
    return [*first, *before], target, value


def of_assignment(
    scope: FunctionScope, target: Value, value: nodes.Expression
) -> tuple[First, Value, nodes.Expression]:
    if target.pure and (_is_variable(target) or not nodes.acts(value)):
        return [], target, value
    first, read = keep(scope, value)
    before, target = ([], target) if target.pure else settle(scope, target)
    return [*first, *before], target, read
