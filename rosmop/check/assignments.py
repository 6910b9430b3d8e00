"""Assignments: to variables, elements, fields, characters and parts of times.

A parameter that is bound to a field remembers that it was assigned, because only then the field is written.
"""

from rosmop.check.assignables import (
    CharacterPlace,
    ElementPlace,
    PartPlace,
    Place,
    SlotPlace,
    Value,
    VariablePlace,
    root,
)
from rosmop.check.scope import Scope
from rosmop.form import nodes
from rosmop.text.errors import SpecificationError
from rosmop.types import value_types


def require_place(target: Value, what: str) -> Place:
    """The place of a value that is to be assigned; refuses constants and values that live nowhere."""
    if target.place is None:
        raise SpecificationError.at(target.position, f"{what} needs a variable, a field or an element")
    variable = root(target)
    if variable is not None and variable.constant:
        raise SpecificationError.at(target.position, f"`{variable.name}` is const")
    return target.place


def require_original(target: Value) -> None:
    """Refuse to write into a `char *` or `T name[]` that is a copy: C++ would change what it was copied from."""
    variable = root(target)
    if variable is not None and variable.copied:
        raise SpecificationError.at(
            target.position,
            f"`{variable.name}` is a copy here, and its original would not change; use a `std::string`"
            " or `std::vector` (as a parameter: a reference to one)",
        )


def note_copy(target: Value, value: Value) -> None:
    """Remember that a `char *` was given another's characters."""
    variable = root(target)
    if variable is not None and value.place is not None and isinstance(value.type, value_types.Characters):
        variable.copied = variable.copied or isinstance(variable.type, value_types.Characters)


def store(scope: Scope, target: Value, value: nodes.Expression) -> nodes.Expression:
    """An expression that assigns and has the value assigned."""
    stored = _store(scope, require_place(target, "an assignment"), value)
    return marked(mark(scope, target), stored)


def write_store(scope: Scope, target: Value, value: nodes.Expression) -> None:
    """Write the statements that assign."""
    place = require_place(target, "an assignment")
    flag = mark(scope, target)
    scope.evaluate(_store(scope, place, value))
    if flag is not None:
        scope.evaluate(nodes.Assign(value_types.BOOL, flag, nodes.Literal(value_types.BOOL, True)))


def marked(flag: str | None, change: nodes.Expression) -> nodes.Expression:
    """An expression that changes a place, which sets the flag for that, if there is one."""
    if flag is None:
        return change
    assigned = nodes.Assign(value_types.BOOL, flag, nodes.Literal(value_types.BOOL, True))
    return nodes.Sequence(change.type, (assigned, change), 1)


def mark(scope: Scope, target: Value) -> str | None:
    """The flag to set when (a part of) this place changes, None if nobody asks."""
    variable = root(target)
    scope.changes = True
    if variable is None:
        return None
    if variable.shared:
        scope.changes_shared.add(variable.code)
    if not isinstance(target.place, VariablePlace) or target.place.variable.alias is not None:
        require_original(target)
    variable.assigned = variable.used = True
    return variable.flag


def _store(scope: Scope, place: Place, value: nodes.Expression) -> nodes.Expression:
    if isinstance(place, VariablePlace):
        if place.variable.alias is not None:
            return _store(scope, require_place(place.variable.alias, "an assignment"), value)
        _note(scope, place)
        return nodes.Assign(place.variable.type, place.variable.code, value)
    if isinstance(place, ElementPlace):
        return nodes.Call(value.type, "a_put", (place.base.form, place.index, value), place.site)
    if isinstance(place, SlotPlace):
        slot = nodes.Literal(value_types.INT, place.slot)
        return nodes.Call(value.type, "a_slot", (place.base.form, slot, value))
    return _store_part(scope, place, value)


def _store_part(scope: Scope, place: Place, value: nodes.Expression) -> nodes.Expression:
    """Strings and times do not change in place: the whole is stored anew."""
    assert isinstance(place, CharacterPlace | PartPlace)  # the last kinds of places
    inner, base = require_place(place.base, "an assignment"), place.base.form
    if isinstance(place, PartPlace):
        part = nodes.Literal(value_types.VOID, place.part.encode())
        return _store(scope, inner, nodes.Call(base.type, "a_part", (base, part, value), place.site))
    changed = nodes.Call(base.type, "a_character", (base, place.index, value), place.site)
    return _store(scope, inner, changed)


def _note(scope: Scope, place: VariablePlace) -> None:
    if place.variable.shared:
        scope.written.add(place.variable.code)
