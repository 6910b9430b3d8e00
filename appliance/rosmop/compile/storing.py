"""Assignments as code: to variables, elements, fields, characters and parts of times.

A parameter that is bound to a field remembers that it was assigned, because only then the field is written.
"""

from appliance.rosmop.compile.places import (
    CharacterPlace,
    ElementPlace,
    PartPlace,
    Place,
    SlotPlace,
    Value,
    VariablePlace,
    root,
)
from appliance.rosmop.compile.scope import Scope
from appliance.rosmop.runtime import texts, times, vectors
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.types import kinds

FUNCTIONS = {
    "a_put": vectors.put,
    "a_slot": vectors.put_slot,
    "a_character": texts.with_character,
    "a_part": times.with_part,
}


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
    if variable is not None and value.place is not None and isinstance(value.type, kinds.Characters):
        variable.copied = variable.copied or isinstance(variable.type, kinds.Characters)


def store(scope: Scope, target: Value, code: str) -> str:
    """An expression that assigns and has the value assigned."""
    stored = _store(scope, require_place(target, "an assignment"), code)
    flag = mark(scope, target)
    return f"(({flag} := True), {stored})[1]" if flag else stored


def store_lines(scope: Scope, target: Value, code: str) -> list[str]:
    """Statements that assign."""
    place = require_place(target, "an assignment")
    flag = mark(scope, target)
    lines = [f"{flag} = True"] if flag else []
    if isinstance(place, VariablePlace) and place.variable.alias is None:
        _note(scope, place)
        return [f"{place.variable.code} = {code}", *lines]
    if isinstance(place, SlotPlace):
        return [f"{place.base.code}[{place.slot}] = {code}", *lines]
    return [_store(scope, place, code), *lines]


def mark(scope: Scope, target: Value) -> str | None:
    """The flag to set when (a part of) this place changes, None if nobody asks."""
    variable = root(target)
    scope.changes = True
    if variable is None:
        return None
    scope.changes_shared = scope.changes_shared or variable.shared
    if not isinstance(target.place, VariablePlace) or target.place.variable.alias is not None:
        require_original(target)
    variable.assigned = variable.used = True
    return variable.flag


def _store(scope: Scope, place: Place, code: str) -> str:
    if isinstance(place, VariablePlace):
        if place.variable.alias is not None:
            return _store(scope, require_place(place.variable.alias, "an assignment"), code)
        _note(scope, place)
        return f"({place.variable.code} := {code})"
    if isinstance(place, ElementPlace):
        return f"a_put({place.base.code}, {place.index}, {code}, {place.site})"
    if isinstance(place, SlotPlace):
        return f"a_slot({place.base.code}, {place.slot}, {code})"
    return _store_part(scope, place, code)


def _store_part(scope: Scope, place: Place, code: str) -> str:
    """Strings and times do not change in place: the whole is stored anew."""
    assert isinstance(place, CharacterPlace | PartPlace)  # the last kinds of places
    inner = require_place(place.base, "an assignment")
    if not place.base.pure:
        raise SpecificationError.at(
            place.base.position, "too much in one step; put the index into a variable first"
        )
    if isinstance(place, PartPlace):
        return _store(scope, inner, f"a_part({place.base.code}, {place.part!r}, {code}, {place.site})")
    changed = f"a_character({scope.context}, {place.base.code}, {place.index}, {code}, {place.site})"
    return _store(scope, inner, changed)


def _note(scope: Scope, place: VariablePlace) -> None:
    if place.variable.shared:
        scope.written.add(place.variable.code)
