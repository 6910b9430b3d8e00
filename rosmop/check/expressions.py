"""Expressions. One function for each kind of expression of `syntax/tree.py`; types are checked here."""

import math
import re
from collections.abc import Callable, Mapping
from typing import Any

from rosmop.check import (
    assignments,
    call_expressions,
    initializers,
    members,
    operators,
    order,
    vector_members,
)
from rosmop.check.assignables import CharacterPlace, Value, Variable, VariablePlace
from rosmop.check.conversion import condition, constant_value, convert, number
from rosmop.check.margins import noted
from rosmop.check.scope import Scope
from rosmop.check.standard_functions import CONSTANTS
from rosmop.form import nodes
from rosmop.form.positions import Finding, Position
from rosmop.run.interpreter import constant_of
from rosmop.runtime.action_context import FaultError
from rosmop.runtime.numbers import f32
from rosmop.text import tree
from rosmop.text.errors import SpecificationError
from rosmop.types import value_types
from rosmop.types.messages import shown
from rosmop.types.resolve import resolve

_NUMBER = re.compile(r"(0[xX][0-9A-Fa-f]+|[0-9.]+(?:[eE][+-]?[0-9]+)?)([uUlLfF]*)\Z")
_DECIMAL = re.compile(r"[1-9][0-9]{0,30}")
_MAX_DIGITS = 400


def value_of(scope: Scope, node: tree.Expression) -> Value:
    """The value of an expression; refuses what has no meaning."""
    return _KINDS[type(node)](scope, node)


def literal_number(scope: Scope, node: tree.Number) -> Value:
    """A number literal, with the type C++ gives it."""
    found = _NUMBER.match(node.text)
    if found is None or len(node.text) > _MAX_DIGITS or found[1].count(".") > 1:
        raise SpecificationError.at(node.position, f"{shown(node.text)} is no number")
    text, suffix = found[1], found[2].lower()
    if not text.lower().startswith("0x") and re.search(r"[.eE]", text):
        return _floating(node, float(text), suffix)
    if "f" in suffix:
        raise SpecificationError.at(node.position, f"{shown(node.text)} is no number; write `{text}.0f`")
    return _integer(scope, node, text, suffix)


def _is_beyond_long(node: tree.Number) -> bool:
    """Whether it is a decimal integer without suffix that `long` does not hold."""
    return bool(_DECIMAL.fullmatch(node.text)) and int(node.text) > value_types.LONG.most


def _floating(node: tree.Number, value: float, suffix: str) -> Value:
    if suffix not in ("", "f", "l"):
        raise SpecificationError.at(node.position, f"{shown(node.text)} is no number")
    if suffix == "f":
        return constant_value(node.position, value_types.FLOAT, f32(value))
    return constant_value(node.position, value_types.DOUBLE, value)


def _integer(scope: Scope, node: tree.Number, text: str, suffix: str) -> Value:
    decimal = text == "0" or text[0] != "0"
    try:
        value = int(text, 10 if decimal else 16 if text[1:2] in ("x", "X") else 8)
    except ValueError:
        raise SpecificationError.at(
            node.position, f"{shown(node.text)} is no number; one that begins with 0 is octal"
        ) from None
    candidates: list[value_types.Integer] = [
        value_types.INT,
        value_types.UINT,
        value_types.LONG,
        value_types.ULONG,
    ]
    if "l" in suffix:
        candidates = candidates[2:]
    candidates = [
        kind for kind in candidates if not (kind.signed if "u" in suffix else decimal and not kind.signed)
    ]
    for kind in candidates:
        if value <= kind.most:
            return constant_value(node.position, kind, value)
    if value <= value_types.ULONG.most:  # g++ has a type of 128 bits for it, and warns, too
        warning = (
            f"{shown(node.text)} is larger than `long` holds, and an `unsigned long` here; write `{text}u`"
        )
        scope.shared.findings.append(Finding(node.position, "warning", warning))
        return constant_value(node.position, value_types.ULONG, value)
    raise SpecificationError.at(node.position, f"{shown(node.text)} is larger than any integer type holds")


def folded(operands: tuple[Value, ...], make: Callable[..., Value]) -> Value:
    """The value that `make` makes of the operands; if all are numbers that are known, so is what comes of them."""
    if not all(isinstance(operand.constant, int | float) for operand in operands):
        return make(*operands)
    known = [
        constant_value(operand.position, operand.type, operand.constant)
        for operand in operands
        if operand.constant is not None
    ]
    value = make(*known)
    if not value_types.is_number(value.type):
        return value
    try:
        constant = constant_of(value.form)
    except FaultError:
        return value
    return constant_value(value.position, value.type, constant)


# Each kind of expression


def _text(_scope: Scope, node: tree.Text) -> Value:
    return constant_value(node.position, value_types.STRING, node.value)


def _character(_scope: Scope, node: tree.Character) -> Value:
    return constant_value(node.position, value_types.CHAR, node.value)


def _name(scope: Scope, node: tree.Name) -> Value:
    parts = node.parts
    if parts == ("MESSAGE",):
        return _message(scope, node)
    if len(parts) == 1:
        variable = scope.find(parts[0], node.position)
        if variable is not None:
            return read(variable, node)
    if parts in CONSTANTS:
        kind, constant = CONSTANTS[parts]
        return constant_value(node.position, kind, constant)
    if len(parts) == 3:
        return members.constant(scope, "/".join(parts[:2]), parts[2], node.position)
    if len(parts) == 1 and parts[0] in scope.names.functions:
        raise SpecificationError.at(node.position, f"{shown(parts[0])} is a function; write `{parts[0]}(…)`")
    name = "::".join(parts)
    if parts[-1] in ("cout", "cerr", "endl"):
        raise SpecificationError.at(
            node.position, f"{shown(name)} stands at the start of a statement, or after `<<`"
        )
    raise scope.unknown(name, node.position)


def read(variable: Variable, node: tree.Node) -> Value:
    """The value of a variable."""
    variable.used = True
    if variable.alias is not None:
        alias = variable.alias
        return Value(alias.form, node.position, VariablePlace(variable), owned=False)
    place, value = VariablePlace(variable), nodes.Read(variable.type, variable.code)
    return Value(value, node.position, place, owned=False, constant=variable.known)


def _message(scope: Scope, node: tree.Expression) -> Value:
    if scope.message_type is None:
        hint = {
            "handler": "a handler has no message; copy it in the action: `v = MESSAGE;`",
            "timer": "a timer has no message",
            "init": "there is no message yet",
            "function": "a function has no message; pass it what it needs",
        }.get(scope.role, "there is no message here")
        raise SpecificationError.at(node.position, f"`MESSAGE` has no meaning here: {hint}")
    scope.pending = scope.pending or scope.symbols.fresh("u")
    whole = nodes.Whole(value_types.Record(scope.message_type), scope.pending, scope.lines.site)
    return Value(whole, node.position)


def _unary(scope: Scope, node: tree.Unary) -> Value:
    if node.operator == "-" and isinstance(node.operand, tree.Number) and _is_beyond_long(node.operand):
        if int(node.operand.text) == -value_types.LONG.least:
            return constant_value(node.position, value_types.LONG, value_types.LONG.least)
        raise SpecificationError.at(
            node.position, f"{shown('-' + node.operand.text)} is less than any integer type holds"
        )
    site = scope.site(node)
    return folded(
        (value_of(scope, node.operand),),
        lambda operand: operators.unary(node.operator, operand, node.position, site),
    )


def _step(scope: Scope, node: tree.Step) -> Value:
    target = value_of(scope, node.target)
    assignments.require_place(target, f"`{node.operator}`")
    first, target = ([], target) if target.pure else order.settled(scope, target)
    one = constant_value(node.position, value_types.INT, 1)
    operands = operators.Operands(scope, node.position, target, one, scope.site(node))
    changed = convert(scope, operators.binary(node.operator[0], operands), target.type)
    stored = assignments.store(scope, target, changed)
    before = nodes.Sequence(target.type, (target.form, stored), 0)
    return order.after(first, Value(stored if node.prefix else before, node.position))


def _binary(scope: Scope, node: tree.Binary) -> Value:
    operands, site = (value_of(scope, node.left), value_of(scope, node.right)), scope.site(node)
    if node.operator in operators.COMPARISONS and any(
        isinstance(operand.constant, float) and math.isnan(operand.constant) for operand in operands
    ):
        truth = "always true" if node.operator == "!=" else "never true"
        text = f"`{node.operator}` with NaN is {truth}; to find NaN write `std::isnan(…)`"
        scope.shared.findings.append(Finding(node.position, "warning", text))
    value = folded(
        operands,
        lambda left, right: operators.binary(
            node.operator, operators.Operands(scope, node.position, left, right, site)
        ),
    )
    return noted(scope, node, *operands, value)


def _assign(scope: Scope, node: tree.Assign) -> Value:
    first, target, value = assignment(scope, node)
    return order.after(first, Value(assignments.store(scope, target, value), node.position, owned=False))


def assignment(scope: Scope, node: tree.Assign) -> tuple[order.First, Value, nodes.Expression]:
    """What comes before an assignment, its target, and the value it gets."""
    whole = node.target
    while isinstance(whole, tree.Member | tree.Index):
        whole = whole.base
    if isinstance(whole, tree.Name) and whole.parts == ("MESSAGE",):
        raise SpecificationError.at(
            node.position,
            "`MESSAGE` cannot be assigned; bind the fields you want to change, `'{field:x}'`, and write `x = …;`",
        )
    target = value_of(scope, node.target)
    assignments.require_place(target, f"`{node.operator}`")
    if node.operator == "=" and isinstance(node.value, tree.Elements):
        return order.of_assignment(scope, target, initializers.elements(scope, node.value, target.type))
    value, site = value_of(scope, node.value), scope.site(node.value)
    if node.operator == "=" and (target.pure or value_types.is_number(target.type)):
        return order.of_assignment(scope, target, _assigned(scope, target, value, site))
    first, target, value = order.of_change(scope, target, value)
    if node.operator == "=":  # of a class: C++ looks at what is assigned when all places are known
        return first, target, _assigned(scope, target, value, site)
    operands = operators.Operands(scope, node.position, target, value, scope.site(node))
    if node.operator == "+=" and isinstance(target.type, value_types.String):
        return first, target, operators.extended(operands).form
    return first, target, convert(scope, operators.binary(node.operator[:-1], operands), target.type)


def _assigned(scope: Scope, target: Value, value: Value, site: int) -> nodes.Expression:
    """What a place is given: C++ takes a character for a string, too."""
    if isinstance(target.type, value_types.String) and value.type == value_types.CHAR:
        return nodes.Call(value_types.STRING, "t_byte", (value.form,))
    assignments.note_copy(target, value)
    return convert(scope, value, target.type, site)


def _conditional(scope: Scope, node: tree.Conditional) -> Value:
    values = tuple(value_of(scope, part) for part in (node.condition, node.yes, node.no))
    return folded(values, lambda test, yes, no: _either(scope, node.position, test, yes, no))


def _either(scope: Scope, position: Position, tested: Value, yes: Value, no: Value) -> Value:
    test = condition(tested)
    if value_types.is_number(yes.type) and value_types.is_number(no.type):
        kind = yes.type if yes.type == no.type else value_types.common(yes.type, no.type)
        either = [number(side.form, kind) for side in (yes, no)]
    elif value_types.convertible(no.type, yes.type):
        kind = value_types.STRING if isinstance(yes.type, value_types.Characters) else yes.type
        either = [
            convert(scope, side, kind) if value_types.is_scalar(kind) or side.type != kind else side.form
            for side in (yes, no)
        ]
    else:
        raise SpecificationError.at(
            no.position, f"`?:` between {yes.type} and {no.type}; make them the same type"
        )
    chosen = nodes.Conditional(kind, test, *either)
    return Value(chosen, position, owned=yes.owned and no.owned)


def _sequence(scope: Scope, node: tree.Sequence) -> Value:
    values = [value_of(scope, item) for item in node.items]
    all_of_them = nodes.Sequence(values[-1].type, tuple(value.form for value in values), -1)
    return Value(all_of_them, node.position, owned=values[-1].owned)


def _index(scope: Scope, node: tree.Index) -> Value:
    indexed = value_of(scope, node.base), value_of(scope, node.index)
    first, base, (index,) = order.of_member(scope, indexed[0], indexed[1:])
    site = scope.site(node)
    if isinstance(base.type, value_types.Vector):
        return order.after(first, vector_members.element_value(base, index, node.position, site))
    if isinstance(base.type, value_types.String | value_types.Characters):
        at = convert(scope, index, value_types.LONG)
        place = CharacterPlace(base, at, site) if base.place is not None else None
        character = nodes.Call(value_types.CHAR, "e_character", (base.form, at), site)
        return order.after(first, Value(character, node.position, place))
    raise SpecificationError.at(node.position, f"{base.type} has no elements")


def _member(scope: Scope, node: tree.Member) -> Value:
    return members.field(scope, value_of(scope, node.base), node.name, node.position, scope.site(node))


def _cast(scope: Scope, node: tree.Cast) -> Value:
    target = resolve(node.type, scope.messages)
    return folded(
        (value_of(scope, node.operand),),
        lambda value: Value(convert(scope, value, target), node.position),
    )


def _construct(scope: Scope, node: tree.Construct) -> Value:
    kind = resolve(node.type, scope.messages)
    if value_types.is_number(kind) and len(node.arguments) == 1:
        return _cast(scope, tree.Cast(node.position, node.type, node.arguments[0]))
    return call_expressions.construct(scope, node.position, kind, node.arguments)


def _new(scope: Scope, node: tree.NewCharacters) -> Value:
    size = convert(scope, value_of(scope, node.size), value_types.ULONG)
    zeros = (size, nodes.Literal(value_types.CHAR, 0))
    return Value(nodes.Call(value_types.CHARACTERS, "e_repeat", zeros, scope.site(node)), node.position)


def _limit(scope: Scope, node: tree.Limit) -> Value:
    kind = resolve(node.type, scope.messages)
    found = call_expressions.limits_of(kind).get(node.name)
    if found is None:
        raise SpecificationError.at(node.position, f"`numeric_limits<{kind}>::{node.name}()` is not known")
    return constant_value(node.position, kind, found)


def _elements(_scope: Scope, node: tree.Expression) -> Value:
    raise SpecificationError.at(
        node.position, "`{…}` has no type here; write `std::vector<type>{…}` or assign it to a variable"
    )


_KINDS: Mapping[type[tree.Expression], Callable[[Scope, Any], Value]] = {
    tree.Number: literal_number,
    tree.Text: _text,
    tree.Character: _character,
    tree.Name: _name,
    tree.Unary: _unary,
    tree.Step: _step,
    tree.Binary: _binary,
    tree.Assign: _assign,
    tree.Conditional: _conditional,
    tree.Sequence: _sequence,
    tree.Index: _index,
    tree.Member: _member,
    tree.Cast: _cast,
    tree.Call: call_expressions.call,
    tree.Construct: _construct,
    tree.NewCharacters: _new,
    tree.Limit: _limit,
    tree.Elements: _elements,
}
