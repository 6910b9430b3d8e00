"""The order of evaluation of C++17, written out: what has effects that others can see goes into a variable first.

The form is evaluated from left to right. Of an assignment the right side comes first, then the indices on the left; of
a call what it is a member of, then the arguments; and what is handed over by reference, or is a member of something, is
looked at when all arguments are there. Where C++ leaves the order open, any will do.
"""

from collections.abc import Sequence
from dataclasses import replace

from rosmop.check.assignables import (
    CharacterPlace,
    ElementPlace,
    PartPlace,
    Place,
    SlotPlace,
    Value,
    VariablePlace,
)
from rosmop.check.scope import Scope
from rosmop.form import nodes
from rosmop.types import value_types
from rosmop.types.value_types import Type

First = list[nodes.Expression]
"""What is evaluated before, in order."""


def after(first: Sequence[nodes.Expression], value: Value) -> Value:
    """A value that is known when something else has been evaluated."""
    if not first:
        return value
    whole = nodes.Sequence(value.type, (*first, value.form), -1)
    return replace(value, form=whole, first=(*first, *value.first))


def kept(scope: Scope, value: nodes.Expression) -> tuple[First, nodes.Expression]:
    """A value in a variable of its own, and what puts it there."""
    if isinstance(value, nodes.Literal):
        return [], value
    name = scope.temporary()
    return [nodes.Assign(value.type, name, value)], nodes.Read(value.type, name)


def settled(scope: Scope, value: Value) -> tuple[First, Value]:
    """A place whose indices nothing changes any more, and what comes first; of what lives nowhere, its value."""
    place = value.place
    if place is None:
        first, read = kept(scope, value.form)
        return first, replace(value, form=read, first=())
    if isinstance(place, VariablePlace):
        return [], value
    assert isinstance(place, ElementPlace | CharacterPlace | SlotPlace | PartPlace)  # the other kinds
    first, base = settled(scope, place.base)
    settled_place: Place = replace(place, base=base)
    if isinstance(place, ElementPlace | CharacterPlace):
        indexed, index = kept(scope, place.index)
        first += indexed
        settled_place = replace(place, base=base, index=index)
    read = _read(value.type, settled_place)
    return [*value.first, *first], replace(value, form=read, place=settled_place, first=())


def _read(kind: Type, place: Place) -> nodes.Expression:
    if isinstance(place, ElementPlace):
        return nodes.Call(kind, "l_element", (place.base.form, place.index), place.site)
    if isinstance(place, CharacterPlace):
        return nodes.Call(kind, "e_character", (place.base.form, place.index), place.site)
    if isinstance(place, SlotPlace):
        return nodes.Item(kind, place.base.form, place.slot)
    assert isinstance(place, PartPlace)  # the last kind
    return nodes.Call(kind, f"m_{place.part}", (place.base.form,))


def arguments(scope: Scope, values: Sequence[Value]) -> tuple[First, list[Value]]:
    """Arguments of a call: those with effects come first, each in its turn."""
    if sum(not isinstance(value.form, nodes.Literal) for value in values) < 2:
        return [], list(values)
    return _in_turn(scope, values)


def _in_turn(scope: Scope, values: Sequence[Value]) -> tuple[First, list[Value]]:
    each = [([], value) if value.pure else settled(scope, value) for value in values]
    return [before for first, _ in each for before in first], [value for _, value in each]


def of_member(scope: Scope, base: Value, values: Sequence[Value]) -> tuple[First, Value, list[Value]]:
    """What a member function is called of, and its arguments; or an element, and its index."""
    if all(value.pure for value in values) and (base.pure or base.place is None):
        return [], base, list(values)
    first, base = ([], base) if base.pure and base.place is None else settled(scope, base)
    before, ordered = _in_turn(scope, values)
    return [*first, *before], base, ordered


def _is_variable(target: Value) -> bool:
    return isinstance(target.place, VariablePlace) and target.place.variable.alias is None


def of_change(scope: Scope, target: Value, value: Value) -> tuple[First, Value, Value]:
    """What `+=` and its like change, and by what: both are looked at when all places are known."""
    if target.pure and value.pure:
        return [], target, value
    if value_types.is_number(value.type):  # of a class only the place is found first
        value = replace(value, place=None)
    first, value = settled(scope, value)
    before, target = ([], target) if target.pure else settled(scope, target)
    return [*first, *before], target, value


def of_assignment(
    scope: Scope, target: Value, value: nodes.Expression
) -> tuple[First, Value, nodes.Expression]:
    """What an assignment changes, and the value that it gets."""
    if target.pure and (_is_variable(target) or not nodes.acts(value)):
        return [], target, value
    first, read = kept(scope, value)
    before, target = ([], target) if target.pure else settled(scope, target)
    return [*first, *before], target, read
