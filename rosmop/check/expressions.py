"""Compile expressions: one function for each class of expression in `text/tree.py`, with its type checks."""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import msgspec

from rosmop.check import (
    assignments,
    call_expressions,
    members,
    operators,
    order,
    vector_members,
)
from rosmop.check.assignables import CharacterLvalue, Value, Variable, VariableLvalue
from rosmop.check.conversion import condition, constant_value, convert, number
from rosmop.check.scope import FunctionScope
from rosmop.check.standard_functions import CONSTANTS
from rosmop.form import nodes
from rosmop.form.compiled import Comparison
from rosmop.form.findings import Diagnostic, Position, SpecificationError
from rosmop.run.interpreter import constant_of
from rosmop.runtime.action_context import FaultError
from rosmop.runtime.numbers import f32
from rosmop.text import tree
from rosmop.types import value_types
from rosmop.types.messages import quote
from rosmop.types.resolve import resolve

# Note how close comparisons of numbers came: both sides when they were nearest, while true and while false.
#
# The noting expression has the same value, compares the sides in the same type, and charges nothing.
# Comparisons in `when`, first values and `init` are not noted, nor are loop conditions, whose distance from the
# end means nothing.

MAX_NOTED = 32

_COMPARED = frozenset({"<", "<=", ">", ">="})
_TRUE, _FALSE = (nodes.Literal(value_types.BOOL, truth) for truth in (True, False))


def note_comparison(
    scope: FunctionScope, node: tree.BinaryExpression, left: Value, right: Value, value: Value
) -> Value:
    compare = value.form
    if (
        not scope.notes
        or node.operator not in _COMPARED
        or not isinstance(compare, nodes.Compare)
        or not value_types.is_number(compare.left.type)
    ):
        return value
    known = scope.names.comparisons
    if node not in known:
        if len(known) >= MAX_NOTED:
            return value
        variables = [(scope.symbols.fresh("g"), scope.symbols.fresh("g")) for _truth in range(2)]
        constant = (side for side, operand in enumerate((left, right)) if operand.constant is not None)
        known[node] = Comparison(node.position, next(constant, None), *variables)
    comparison = known[node]
    scope.effects.written.update(comparison.variables)
    kind = compare.left.type
    sides = [nodes.Read(kind, scope.temporary()) for _side in range(2)]
    kept = (
        nodes.Assign(kind, side.name, operand)
        for side, operand in zip(sides, (compare.left, compare.right), strict=True)
    )
    now = [number(side, value_types.DOUBLE) for side in sides]
    answer = nodes.Conditional(
        value_types.BOOL,
        msgspec.structs.replace(compare, left=sides[0], right=sides[1]),
        nodes.Sequence(value_types.BOOL, (_note(now, comparison.when_true), _TRUE), -1),
        nodes.Sequence(value_types.BOOL, (_note(now, comparison.when_false), _FALSE), -1),
    )
    return replace(value, form=nodes.Sequence(value_types.BOOL, (*kept, answer), -1))


def _note(now: list[nodes.Expression], variables: tuple[str, str]) -> nodes.Expression:
    before = [nodes.Read(value_types.DOUBLE, name) for name in variables]
    nearer = nodes.Compare("<", _distance(*now), _distance(*before), -1)
    kept = (nodes.Assign(value_types.DOUBLE, name, side) for name, side in zip(variables, now, strict=True))
    return nodes.Logical("and", nearer, nodes.Sequence(value_types.BOOL, (*kept, _TRUE), -1))


def _distance(left: nodes.Expression, right: nodes.Expression) -> nodes.Expression:
    return nodes.Unary(value_types.DOUBLE, "abs", nodes.Arithmetic(value_types.DOUBLE, "-", left, right, -1))


_NUMBER = re.compile(r"(0[xX][0-9A-Fa-f]++|[0-9.]++(?:[eE][+-]?[0-9]++)?)([uUlLfF]*+)\Z")
_DECIMAL = re.compile(r"[1-9][0-9]{0,30}")
_MAX_DIGITS = 400


def value_of(scope: FunctionScope, node: tree.Expression) -> Value:
    return _KINDS[type(node)](scope, node)


def literal_number(scope: FunctionScope, node: tree.NumberLiteral) -> Value:
    match = _NUMBER.match(node.text)
    if match is None or len(node.text) > _MAX_DIGITS or match[1].count(".") > 1:
        raise SpecificationError.at(node.position, f"{quote(node.text)} is not a number")
    text, suffix = match[1], match[2].lower()
    if not text.lower().startswith("0x") and re.search(r"[.eE]", text):
        return _floating(node, float(text), suffix)
    if "f" in suffix:
        raise SpecificationError.at(node.position, f"{quote(node.text)} is not a number; write `{text}.0f`")
    return _integer(scope, node, text, suffix)


def _is_beyond_long(node: tree.NumberLiteral) -> bool:
    return bool(_DECIMAL.fullmatch(node.text)) and int(node.text) > value_types.LONG.most


def _floating(node: tree.NumberLiteral, value: float, suffix: str) -> Value:
    if suffix not in ("", "f", "l"):
        raise SpecificationError.at(node.position, f"{quote(node.text)} is not a number")
    if suffix == "f":
        return constant_value(node.position, value_types.FLOAT, f32(value))
    return constant_value(node.position, value_types.DOUBLE, value)


def _integer(scope: FunctionScope, node: tree.NumberLiteral, text: str, suffix: str) -> Value:
    decimal = text == "0" or text[0] != "0"
    try:
        value = int(text, 10 if decimal else 16 if text[1:2] in ("x", "X") else 8)
    except ValueError:
        raise SpecificationError.at(
            node.position, f"{quote(node.text)} is not a number; one that begins with 0 is octal"
        ) from None
    candidates: list[value_types.IntegerType] = [
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
    if value <= value_types.ULONG.most:  # g++ uses a 128-bit type for this value, and also warns
        warning = (
            f"{quote(node.text)} is larger than `long` holds, and an `unsigned long` here; write `{text}u`"
        )
        scope.shared.findings.append(Diagnostic(node.position, "warning", warning))
        return constant_value(node.position, value_types.ULONG, value)
    raise SpecificationError.at(node.position, f"{quote(node.text)} is larger than any integer type holds")


def fold(operands: tuple[Value, ...], make: Callable[..., Value]) -> Value:
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


def _text(_scope: FunctionScope, node: tree.StringLiteral) -> Value:
    return constant_value(node.position, value_types.STRING, node.value)


def _character(_scope: FunctionScope, node: tree.CharacterLiteral) -> Value:
    return constant_value(node.position, value_types.CHAR, node.value)


def _name(scope: FunctionScope, node: tree.Name) -> Value:
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
        raise SpecificationError.at(node.position, f"{quote(parts[0])} is a function; write `{parts[0]}(…)`")
    name = "::".join(parts)
    if parts[-1] in ("cout", "cerr", "endl"):
        raise SpecificationError.at(
            node.position, f"{quote(name)} is only allowed at the start of a statement, or after `<<`"
        )
    raise scope.unknown(name, node.position)


def read(variable: Variable, node: tree.SyntaxNode) -> Value:
    variable.used = True
    if variable.alias is not None:
        alias = variable.alias
        return Value(alias.form, node.position, VariableLvalue(variable), owned=False)
    lvalue = VariableLvalue(variable)
    if variable.table is not None:
        return Value(nodes.Literal(variable.type, variable.table), node.position, lvalue, owned=False)
    value = nodes.Read(variable.type, variable.code)
    return Value(value, node.position, lvalue, owned=False, constant=variable.known)


def _message(scope: FunctionScope, node: tree.Expression) -> Value:
    if scope.handled.message_type is None:
        hint = {
            "handler": "a handler has no message; copy it in the action: `v = MESSAGE;`",
            "timer": "a timer has no message",
            "init": "there is no message yet",
            "function": "a function has no message; pass it the values it needs",
        }.get(scope.role, "there is no message here")
        raise SpecificationError.at(node.position, f"`MESSAGE` has no meaning here: {hint}")
    scope.handled.pending = scope.handled.pending or scope.symbols.fresh("u")
    whole = nodes.Whole(
        value_types.RecordType(scope.handled.message_type), scope.handled.pending, scope.lines.site
    )
    return Value(whole, node.position)


def _unary(scope: FunctionScope, node: tree.UnaryExpression) -> Value:
    if (
        node.operator == "-"
        and isinstance(node.operand, tree.NumberLiteral)
        and _is_beyond_long(node.operand)
    ):
        if int(node.operand.text) == -value_types.LONG.least:
            return constant_value(node.position, value_types.LONG, value_types.LONG.least)
        raise SpecificationError.at(
            node.position, f"{quote('-' + node.operand.text)} is less than any integer type holds"
        )
    site = scope.site(node)
    return fold(
        (value_of(scope, node.operand),),
        lambda operand: operators.unary(node.operator, operand, node.position, site),
    )


def _step(scope: FunctionScope, node: tree.IncrementExpression) -> Value:
    target = value_of(scope, node.target)
    assignments.require_place(target, f"`{node.operator}`")
    first, target = ([], target) if target.pure else order.settle(scope, target)
    value = constant_value(node.position, value_types.INT, 1)
    operands = operators.Operands(scope, node.position, target, value, scope.site(node))
    changed = convert(scope, operators.binary(node.operator[0], operands), target.type)
    stored = assignments.store(scope, target, changed)
    before = nodes.Sequence(target.type, (target.form, stored), 0)
    return order.after(first, Value(stored if node.prefix else before, node.position))


def _binary(scope: FunctionScope, node: tree.BinaryExpression) -> Value:
    operands, site = (value_of(scope, node.left), value_of(scope, node.right)), scope.site(node)
    if node.operator in operators.COMPARISONS and any(
        isinstance(operand.constant, float) and math.isnan(operand.constant) for operand in operands
    ):
        truth = "always true" if node.operator == "!=" else "never true"
        text = f"`{node.operator}` with NaN is {truth}; to find NaN write `std::isnan(…)`"
        scope.shared.findings.append(Diagnostic(node.position, "warning", text))
    value = fold(
        operands,
        lambda left, right: operators.binary(
            node.operator, operators.Operands(scope, node.position, left, right, site)
        ),
    )
    return note_comparison(scope, node, *operands, value)


def _assign(scope: FunctionScope, node: tree.Assignment) -> Value:
    first, target, value = assignment(scope, node)
    return order.after(first, Value(assignments.store(scope, target, value), node.position, owned=False))


def assignment(scope: FunctionScope, node: tree.Assignment) -> tuple[order.First, Value, nodes.Expression]:
    whole = node.target
    while isinstance(whole, tree.MemberAccess | tree.IndexExpression):
        whole = whole.base
    if isinstance(whole, tree.Name) and whole.parts == ("MESSAGE",):
        raise SpecificationError.at(
            node.position,
            "`MESSAGE` cannot be assigned; bind the fields you want to change, `'{field:x}'`, and write `x = …;`",
        )
    target = value_of(scope, node.target)
    assignments.require_place(target, f"`{node.operator}`")
    if node.operator == "=" and isinstance(node.value, tree.InitializerList):
        return order.of_assignment(scope, target, call_expressions.elements(scope, node.value, target.type))
    value, site = value_of(scope, node.value), scope.site(node.value)
    if node.operator == "=" and (target.pure or value_types.is_number(target.type)):
        return order.of_assignment(scope, target, _assigned(scope, target, value, site))
    first, target, value = order.of_change(scope, target, value)
    if node.operator == "=":  # for a class, C++ reads the assigned value after all places are known
        return first, target, _assigned(scope, target, value, site)
    operands = operators.Operands(scope, node.position, target, value, scope.site(node))
    if node.operator == "+=" and isinstance(target.type, value_types.StringType):
        return first, target, operators.extend(operands).form
    return first, target, convert(scope, operators.binary(node.operator[:-1], operands), target.type)


def _assigned(scope: FunctionScope, target: Value, value: Value, site: int) -> nodes.Expression:
    if isinstance(target.type, value_types.StringType) and value.type == value_types.CHAR:
        return nodes.Call(value_types.STRING, "t_byte", (value.form,))
    assignments.note_copy(target, value)
    return convert(scope, value, target.type, site)


def _conditional(scope: FunctionScope, node: tree.ConditionalExpression) -> Value:
    values = tuple(value_of(scope, part) for part in (node.condition, node.yes, node.no))
    return fold(values, lambda test, yes, no: _either(scope, node.position, test, yes, no))


def _either(scope: FunctionScope, position: Position, tested: Value, yes: Value, no: Value) -> Value:
    test = condition(tested)
    if value_types.is_number(yes.type) and value_types.is_number(no.type):
        kind = yes.type if yes.type == no.type else value_types.common(yes.type, no.type)
        either = [number(side.form, kind) for side in (yes, no)]
    elif value_types.convertible(no.type, yes.type):
        kind = value_types.STRING if isinstance(yes.type, value_types.CharactersType) else yes.type
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


def _sequence(scope: FunctionScope, node: tree.CommaExpression) -> Value:
    values = [value_of(scope, item) for item in node.items]
    all_of_them = nodes.Sequence(values[-1].type, tuple(value.form for value in values), -1)
    return Value(all_of_them, node.position, owned=values[-1].owned)


def _index(scope: FunctionScope, node: tree.IndexExpression) -> Value:
    indexed = value_of(scope, node.base), value_of(scope, node.index)
    first, base, (index,) = order.of_member(scope, indexed[0], indexed[1:])
    site = scope.site(node)
    if isinstance(base.type, value_types.VectorType):
        return order.after(first, vector_members.element_value(base, index, node.position, site))
    if isinstance(base.type, value_types.StringType | value_types.CharactersType):
        at = convert(scope, index, value_types.LONG)
        lvalue = CharacterLvalue(base, at, site) if base.place is not None else None
        character = nodes.Call(value_types.CHAR, "e_character", (base.form, at), site)
        return order.after(first, Value(character, node.position, lvalue))
    raise SpecificationError.at(node.position, f"{base.type} has no elements")


def _member(scope: FunctionScope, node: tree.MemberAccess) -> Value:
    return members.field(scope, value_of(scope, node.base), node.name, node.position, scope.site(node))


def _cast(scope: FunctionScope, node: tree.CastExpression) -> Value:
    target = resolve(node.type, scope.messages)
    return fold(
        (value_of(scope, node.operand),), lambda value: Value(convert(scope, value, target), node.position)
    )


def _construct(scope: FunctionScope, node: tree.ConstructorCall) -> Value:
    kind = resolve(node.type, scope.messages)
    if value_types.is_number(kind) and len(node.arguments) == 1:
        return _cast(scope, tree.CastExpression(node.position, node.type, node.arguments[0]))
    return call_expressions.construct(scope, node.position, kind, node.arguments)


def _new(scope: FunctionScope, node: tree.NewExpression) -> Value:
    size = convert(scope, value_of(scope, node.size), value_types.ULONG)
    zeros = (size, nodes.Literal(value_types.CHAR, 0))
    return Value(nodes.Call(value_types.CHARACTERS, "e_repeat", zeros, scope.site(node)), node.position)


def _limit(scope: FunctionScope, node: tree.NumericLimit) -> Value:
    kind = resolve(node.type, scope.messages)
    found = call_expressions.limits_of(kind).get(node.name)
    if found is None:
        raise SpecificationError.at(node.position, f"`numeric_limits<{kind}>::{node.name}()` is not known")
    return constant_value(node.position, kind, found)


def _elements(_scope: FunctionScope, node: tree.Expression) -> Value:
    raise SpecificationError.at(
        node.position, "`{…}` has no type here; write `std::vector<type>{…}` or assign it to a variable"
    )


_KINDS: Mapping[type[tree.Expression], Callable[[FunctionScope, Any], Value]] = {
    tree.NumberLiteral: literal_number,
    tree.StringLiteral: _text,
    tree.CharacterLiteral: _character,
    tree.Name: _name,
    tree.UnaryExpression: _unary,
    tree.IncrementExpression: _step,
    tree.BinaryExpression: _binary,
    tree.Assignment: _assign,
    tree.ConditionalExpression: _conditional,
    tree.CommaExpression: _sequence,
    tree.IndexExpression: _index,
    tree.MemberAccess: _member,
    tree.CastExpression: _cast,
    tree.CallExpression: call_expressions.call,
    tree.ConstructorCall: _construct,
    tree.NewExpression: _new,
    tree.NumericLimit: _limit,
    tree.InitializerList: _elements,
}
