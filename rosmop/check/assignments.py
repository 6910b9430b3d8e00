"""Assignments: to variables, elements, fields, characters and parts of times.

A parameter that is bound to a field remembers whether it was assigned, because only then is the field written.
"""

from rosmop.check.assignables import (
    CharacterLvalue,
    ElementLvalue,
    FieldLvalue,
    Lvalue,
    TimePartLvalue,
    Value,
    VariableLvalue,
    root,
)
from rosmop.check.scope import FunctionScope
from rosmop.form import nodes
from rosmop.form.findings import SpecificationError
from rosmop.types import value_types


def require_place(target: Value, what: str) -> Lvalue:
    """Return the place to assign; constants and values without a place are rejected."""
    if target.place is None:
        raise SpecificationError.at(target.position, f"{what} needs a variable, a field or an element")
    variable = root(target)
    if variable is not None and variable.constant:
        raise SpecificationError.at(target.position, f"`{variable.name}` is const")
    return target.place


def require_original(target: Value) -> None:
    """Reject writing into a `char *` or `T name[]` that is a copy: C++ would change the original."""
    variable = root(target)
    if variable is not None and variable.copied:
        raise SpecificationError.at(
            target.position,
            f"`{variable.name}` is a copy here, and its original would not change; use a `std::string`"
            " or `std::vector` (as a parameter: a reference to one)",
        )


def note_copy(target: Value, value: Value) -> None:
    variable = root(target)
    if (
        variable is not None
        and value.place is not None
        and isinstance(value.type, value_types.CharactersType)
    ):
        variable.copied = variable.copied or isinstance(variable.type, value_types.CharactersType)


def store(scope: FunctionScope, target: Value, value: nodes.Expression) -> nodes.Expression:
    stored = _store(scope, require_place(target, "an assignment"), value)
    return with_mark(mark(scope, target), stored)


def write_store(scope: FunctionScope, target: Value, value: nodes.Expression) -> None:
    lvalue = require_place(target, "an assignment")
    flag = mark(scope, target)
    scope.evaluate(_store(scope, lvalue, value))
    if flag is not None:
        scope.evaluate(nodes.Assign(value_types.BOOL, flag, nodes.Literal(value_types.BOOL, True)))


def with_mark(flag: str | None, change: nodes.Expression) -> nodes.Expression:
    if flag is None:
        return change
    assigned = nodes.Assign(value_types.BOOL, flag, nodes.Literal(value_types.BOOL, True))
    return nodes.Sequence(change.type, (assigned, change), 1)


def mark(scope: FunctionScope, target: Value) -> str | None:
    variable = root(target)
    scope.effects.changes = True
    if variable is None:
        return None
    if variable.shared:
        scope.effects.shared.add(variable.code)
    if not isinstance(target.place, VariableLvalue) or target.place.variable.alias is not None:
        require_original(target)
    variable.assigned = variable.used = True
    return variable.flag


def _store(scope: FunctionScope, lvalue: Lvalue, value: nodes.Expression) -> nodes.Expression:
    if isinstance(lvalue, VariableLvalue):
        if lvalue.variable.alias is not None:
            return _store(scope, require_place(lvalue.variable.alias, "an assignment"), value)
        _note(scope, lvalue)
        return nodes.Assign(lvalue.variable.type, lvalue.variable.code, value)
    if isinstance(lvalue, ElementLvalue):
        return nodes.Call(value.type, "a_put", (lvalue.base.form, lvalue.index, value), lvalue.site)
    if isinstance(lvalue, FieldLvalue):
        slot = nodes.Literal(value_types.INT, lvalue.slot)
        return nodes.Call(value.type, "a_slot", (lvalue.base.form, slot, value))
    return _store_part(scope, lvalue, value)


def _store_part(scope: FunctionScope, lvalue: Lvalue, value: nodes.Expression) -> nodes.Expression:
    assert isinstance(lvalue, CharacterLvalue | TimePartLvalue)  # the remaining kinds of places
    inner, base = require_place(lvalue.base, "an assignment"), lvalue.base.form
    if isinstance(lvalue, TimePartLvalue):
        part = nodes.Literal(value_types.VOID, lvalue.part.encode())
        return _store(scope, inner, nodes.Call(base.type, "a_part", (base, part, value), lvalue.site))
    changed = nodes.Call(base.type, "a_character", (base, lvalue.index, value), lvalue.site)
    return _store(scope, inner, changed)


def _note(scope: FunctionScope, lvalue: VariableLvalue) -> None:
    if lvalue.variable.shared:
        scope.effects.written.add(lvalue.variable.code)
