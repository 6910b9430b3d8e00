"""Compile calls: macros of rosconsole, the library, helper functions, member functions, constructors."""

import math
import re
from collections.abc import Mapping, Sequence

from rosmop.check import cursors, event_facts, members, order
from rosmop.check.assignables import Value, path, root
from rosmop.check.assignments import require_place, store
from rosmop.check.conversion import condition, convert, number
from rosmop.check.invocation import MemberCall
from rosmop.check.print_statements import OutputStream, compile_format
from rosmop.check.scope import ConstantReference, FunctionScope, HelperFunction
from rosmop.check.standard_functions import LIBRARY, Arguments, find_function
from rosmop.form import nodes
from rosmop.form.findings import Position, SpecificationError
from rosmop.text import tree
from rosmop.text.foreign import instead
from rosmop.types import value_types
from rosmop.types.messages import nearest, quote
from rosmop.types.resolve import named_type, record
from rosmop.types.value_types import Type
from roswire.counted import counted

# Compile initial and assigned values: converted expressions, or `{a, b, c}` for a vector.


def convert_value(scope: FunctionScope, node: tree.Expression, target: Type) -> nodes.Expression:
    if isinstance(node, tree.InitializerList):
        return elements(scope, node, target)
    return convert(scope, scope.value_of(node), target, scope.site(node))


def elements(scope: FunctionScope, node: tree.InitializerList, target: Type) -> nodes.Expression:
    if not isinstance(target, value_types.VectorType):
        if len(node.items) == 1:
            return convert_value(scope, node.items[0], target)
        if not node.items:
            return nodes.Zero(target)
        raise SpecificationError.at(
            node.position, f"`{{…}}` makes a vector, not a {target}; set its parts one by one"
        )
    if target.length is not None and len(node.items) > target.length:
        raise SpecificationError.at(
            node.items[target.length].position,
            f"more than the {counted(target.length, 'element')} of the array",
        )
    items = tuple(convert_value(scope, item, target.element) for item in node.items)
    return nodes.Vector(target, items, 0 if target.length is None else target.length - len(items))


_MACRO = re.compile(r"ROS_(DEBUG|INFO|WARN|ERROR|FATAL)(_STREAM)?(_COND|_ONCE|_THROTTLE|_NAMED)?\Z")


def call(scope: FunctionScope, node: tree.CallExpression) -> Value:
    callee = node.callee
    if isinstance(callee, tree.MemberAccess):
        base = scope.value_of(callee.base)
        arguments = [scope.value_of(argument) for argument in node.arguments]
        first, base, arguments = order.of_member(scope, base, arguments)
        at = (node.position, scope.site(node))
        return order.after(first, members.call(MemberCall(scope, base, callee.name, arguments, at)))
    if not isinstance(callee, tree.Name):
        raise SpecificationError.at(node.position, "only functions can be called")
    return _named(scope, node, callee.parts)


def _named(scope: FunctionScope, node: tree.CallExpression, parts: tuple[str, ...]) -> Value:
    function = scope.names.functions.get(parts[0]) if len(parts) == 1 else None
    if function is not None:
        return _helper(scope, node, function)
    macro = _MACRO.match(parts[0]) if len(parts) == 1 else None
    if macro is not None:
        return _macro(scope, node, macro)
    if parts in (("printf",), ("std", "printf")):
        return _log(scope, node, "INFO", node.arguments)
    if parts in (("puts",), ("std", "puts")):
        return _line(scope, node)
    known = _known(scope, node, parts)
    if known is not None:
        return known
    kind = named_type(parts)
    if kind is None and len(parts) == 2 and parts[0] not in ("std", "ros"):
        kind = record(node.position, "/".join(parts), scope.messages)
    if kind is None:
        raise _unknown(scope, node, parts)
    return construct(scope, node.position, kind, node.arguments)


def _known(scope: FunctionScope, node: tree.CallExpression, parts: tuple[str, ...]) -> Value | None:
    if len(parts) == 1 and parts[0] in event_facts.FUNCTIONS:
        return event_facts.fact(scope, node, parts[0])
    if parts[-2:] == ("Time", "now"):
        if node.arguments:
            raise SpecificationError.at(node.position, "`now` takes no argument")
        return Value(nodes.Now(), node.position)
    if parts[0] == "std" and parts[-1] in cursors.ALGORITHMS:
        first, values = order.arguments(scope, [scope.value_of(argument) for argument in node.arguments])
        at = (node.position, scope.site(node))
        return order.after(first, cursors.algorithm(scope, parts[-1], values, at))
    library = find_function(parts, is_library=scope.names.is_library)
    if library is not None:
        first, values = order.arguments(scope, [scope.value_of(argument) for argument in node.arguments])
        return order.after(first, library(Arguments(scope, parts, values, node.position, scope.site(node))))
    return None


def _unknown(scope: FunctionScope, node: tree.CallExpression, parts: tuple[str, ...]) -> SpecificationError:
    name = "::".join(parts)
    if name in scope.names.misdeclared:
        return SpecificationError(())
    advice = instead(parts)
    if advice is not None:
        return SpecificationError.at(node.position, f"unknown function {quote(name)}; {advice}")
    owners = [other.name for other in scope.shared.specifications if parts[0] in other.functions]
    if owners and len(parts) == 1:
        return SpecificationError.at(
            node.position,
            f"{quote(name)} is a function of {owners[0]}; functions belong to their specification",
        )
    known = [
        *scope.names.functions,
        *LIBRARY,
        *event_facts.FUNCTIONS,
        "printf",
        "ROS_INFO",
        "ROS_WARN",
        "ROS_ERROR",
    ]
    hint = nearest(parts[-1], known)
    return SpecificationError.at(
        node.position, f"unknown function {quote(name)}{hint if 'mean' in hint else ''}"
    )


# Helper functions


def _helper(scope: FunctionScope, node: tree.CallExpression, function: HelperFunction) -> Value:
    if len(node.arguments) != len(function.parameters):
        raise SpecificationError.at(
            node.position,
            f"`{function.name}` takes {len(function.parameters)} argument(s), not {len(node.arguments)}",
        )
    scope.effects.calls.add(function.name)
    values = [scope.value_of(argument) for argument in node.arguments]
    _check_references(scope, function, values)
    first, values = order.arguments(scope, values)
    handed: list[nodes.Expression] = []
    targets: list[Value] = []
    for argument, parameter, value in zip(node.arguments, function.parameters, values, strict=True):
        if parameter in function.references:
            before, target = order.settle(scope, value)
            first += before
            targets.append(target)
            handed.append(target.form)
        elif parameter.constant and value.type == parameter.type:
            handed.append(value.form)
        else:
            handed.append(convert(scope, value, parameter.type, scope.site(argument)))
    depth = scope.recursive if function.recursive else None
    call = nodes.Invoke(function.result, function.code, tuple(handed), depth)
    if not targets:
        return order.after(first, Value(call, node.position))
    result = nodes.Read(value_types.VOID, scope.temporary())
    stores = [store(scope, target, nodes.Item(target.type, result, i)) for i, target in enumerate(targets, 1)]
    items = (
        nodes.Assign(value_types.VOID, result.name, call),
        *stores,
        nodes.Item(function.result, result, 0),
    )
    return order.after(first, Value(nodes.Sequence(function.result, items, -1), node.position))


def _check_references(scope: FunctionScope, function: HelperFunction, values: Sequence[Value]) -> None:
    """Reject references that a copy cannot replace, and note shared variables passed as constant references."""
    handed: list[tuple[Value, bool]] = []
    for parameter, value in zip(function.parameters, values, strict=True):
        changes = parameter in function.references
        if changes:
            _check_referenced(value, parameter.type, function)
        elif not parameter.constant or value.type != parameter.type or value.place is None:
            continue
        for other, other_changes in handed:
            if changes or other_changes:
                _check_apart(other, value, function)
        handed.append((value, changes))
        variable = root(value)
        if not changes and variable is not None and variable.shared:
            scope.names.lent.append(ConstantReference(value.position, function.name, parameter, variable))


def _check_referenced(value: Value, kind: value_types.Type, function: HelperFunction) -> None:
    require_place(value, f"a reference parameter of `{function.name}`")
    if value.type != kind:
        raise SpecificationError.at(
            value.position, f"`{function.name}` takes a reference to {kind}; this is {value.type}"
        )
    variable = root(value)
    if variable is not None and variable.shared and variable.name in function.names:
        raise SpecificationError.at(
            value.position,
            f"`{function.name}` uses `{variable.name}` directly, and a reference is a copy until it returns;"
            " use only one of the two",
        )


def _check_apart(value: Value, other: Value, function: HelperFunction) -> None:
    """Reject references to overlapping values: one change would undo the other, or stay invisible."""
    if all(step == beside for step, beside in zip(path(value), path(other), strict=False)):
        raise SpecificationError.at(
            other.position,
            f"`{path(other)[0]}` is passed to two references of `{function.name}`,"
            " which are copies until it returns; pass different variables",
        )


# Output


def _macro(scope: FunctionScope, node: tree.CallExpression, macro: re.Match[str]) -> Value:
    level, stream, variant = macro.groups()
    arguments = list(node.arguments)
    guard: nodes.Expression | None = None
    if variant is not None and variant != "_ONCE":
        if not arguments:
            raise SpecificationError.at(node.position, f"`{macro[0]}` needs a first argument")
        first = scope.value_of(arguments.pop(0))
        if variant == "_COND":
            guard = condition(first)
        elif variant == "_THROTTLE":
            guard = nodes.Throttle(convert(scope, first, value_types.DOUBLE), scope.site(node))
    elif variant == "_ONCE":
        guard = nodes.Throttle(nodes.Literal(value_types.DOUBLE, math.inf), scope.site(node))
    if stream:
        if len(arguments) != 1:
            raise SpecificationError.at(node.position, f"`{macro[0]}` takes the values to print: `a << b`")
        value = compile_stream(scope, node, level, arguments[0])
    else:
        value = _log(scope, node, level, tuple(arguments))
    if guard is None:
        return value
    nothing = nodes.Literal(value_types.VOID, None)
    return Value(nodes.Conditional(value_types.VOID, guard, value.form, nothing), node.position)


def _log(
    scope: FunctionScope, node: tree.CallExpression, level: str, arguments: Sequence[tree.Expression]
) -> Value:
    if not arguments:
        raise SpecificationError.at(node.position, "there is nothing to print; write a string")
    template, *rest = (scope.value_of(argument) for argument in arguments)
    line = nodes.Log(level, compile_format(scope, template, rest), scope.site(node))
    return Value(line, node.position)


def _line(scope: FunctionScope, node: tree.CallExpression) -> Value:
    if len(node.arguments) != 1:
        raise SpecificationError.at(node.position, f"`puts` takes 1 argument(s), not {len(node.arguments)}")
    text = convert(scope, scope.value_of(node.arguments[0]), value_types.STRING)
    return Value(nodes.Log("INFO", text, scope.site(node)), node.position)


def stream_of(node: tree.Expression) -> str | None:
    if not isinstance(node, tree.BinaryExpression):
        return None
    while isinstance(node, tree.BinaryExpression) and node.operator == "<<":
        node = node.left
    if not isinstance(node, tree.Name) or node.parts[:-1] not in ((), ("std",)):
        return None
    return {"cout": "INFO", "cerr": "ERROR", "clog": "INFO"}.get(node.parts[-1])


def compile_stream(
    scope: FunctionScope, node: tree.SyntaxNode, level: str, chain: tree.Expression, *, headed: bool = False
) -> Value:
    """Compile the output of `a << b << c`. If it is `headed`, the first operand is the stream itself."""
    parts: list[tree.Expression] = []
    while isinstance(chain, tree.BinaryExpression) and chain.operator == "<<":
        parts.append(chain.right)
        chain = chain.left
    parts += [] if headed else [chain]
    stream = OutputStream(scope, scope.site(node))
    pieces = [_piece(scope, stream, part) for part in reversed(parts)]
    site = scope.site(node)
    text = nodes.Join(tuple(piece for piece in pieces if piece is not None), site)
    return Value(nodes.Log(level, text, site), node.position)


def _piece(scope: FunctionScope, stream: OutputStream, part: tree.Expression) -> nodes.Expression | None:
    if isinstance(part, tree.Name) and part.parts[-1] == "endl":
        return nodes.Literal(value_types.STRING, b"\n")
    if isinstance(part, tree.CallExpression) and isinstance(part.callee, tree.Name):
        name, arguments = part.callee.parts[-1], part.arguments
        if name == "setprecision" and len(arguments) == 1:
            stream.apply_manipulator(part.callee, scope.value_of(arguments[0]))
            return None
    return None if stream.apply_manipulator(part, None) else stream.piece(scope.value_of(part))


# Constructors


def construct(
    scope: FunctionScope, position: Position, kind: value_types.Type, arguments: Sequence[tree.Expression]
) -> Value:
    if not arguments:
        return Value(nodes.Zero(kind), position)
    values = [
        scope.value_of(argument) for argument in arguments if not isinstance(argument, tree.InitializerList)
    ]
    site = scope.lines.site
    if isinstance(kind, value_types.VectorType):
        return Value(_vector(scope, kind, arguments, values), position)
    if (
        isinstance(kind, value_types.TimeType | value_types.DurationType)
        and values
        and value_types.is_number(values[0].type)
    ):
        return Value(_moment(kind, values, site), position)
    if isinstance(kind, value_types.StringType) and len(values) == 2:
        count = convert(scope, values[0], value_types.ULONG)
        character = convert(scope, values[1], value_types.CHAR)
        return Value(nodes.Call(kind, "e_repeat", (count, character), site), position)
    if len(arguments) != 1 or len(values) != 1 or isinstance(kind, value_types.VoidType):
        raise SpecificationError.at(position, f"{kind} cannot be constructed from this")
    return Value(convert(scope, values[0], kind), position)


def _vector(
    scope: FunctionScope,
    kind: value_types.VectorType,
    arguments: Sequence[tree.Expression],
    values: Sequence[Value],
) -> nodes.Expression:
    site = scope.lines.site
    if len(arguments) == 1 and isinstance(arguments[0], tree.InitializerList):
        return elements(scope, arguments[0], kind)
    if len(values) == 1 and isinstance(values[0].type, value_types.VectorType):
        return convert(scope, values[0], kind, site)
    if not values or len(values) > 2 or not value_types.is_number(values[0].type):
        raise SpecificationError.at(
            arguments[0].position, f"a {kind} is constructed from a size, and a value for all elements"
        )
    count = number(values[0].form, value_types.ULONG)
    if len(values) == 1:
        width = nodes.Literal(value_types.ULONG, scope.values.width(kind.element))
        return nodes.Call(kind, "l_filled", (count, nodes.OfType("zero", kind.element), width), site)
    value = convert(scope, values[1], kind.element, site)
    copy, measure = nodes.OfType("copy", kind.element, site), nodes.OfType("measure", kind.element)
    return nodes.Call(kind, "e_fill", (count, value, copy, measure), site)


def _moment(kind: value_types.Type, values: Sequence[Value], site: int) -> nodes.Expression:
    if len(values) == 1:
        seconds = nodes.Call(value_types.LONG, "m_nanoseconds", (values[0].form,), site)
        limit = "m_time" if isinstance(kind, value_types.TimeType) else "m_duration"
        return nodes.Call(kind, limit, (seconds,), site)
    if len(values) != 2:
        raise SpecificationError.at(values[2].position, f"{kind} takes seconds, or seconds and nanoseconds")
    second, nano = (number(value.form, value_types.LONG) for value in values)
    return nodes.MomentOf(kind, second, nano, site)


def limits_of(kind: value_types.Type) -> Mapping[str, int | float]:
    if isinstance(kind, value_types.IntegerType):
        return {"min": kind.least, "max": kind.most, "lowest": kind.least}
    if isinstance(kind, value_types.FloatingType):
        large = 1.7976931348623157e308 if kind.bits == 64 else 3.4028234663852886e38
        return {
            "max": large,
            "lowest": -large,
            "min": 2.2250738585072014e-308 if kind.bits == 64 else 1.1754943508222875e-38,
            "epsilon": 2.220446049250313e-16 if kind.bits == 64 else 1.1920928955078125e-07,
            "infinity": math.inf,
            "quiet_NaN": math.nan,
        }
    return {}
