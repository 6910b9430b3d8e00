"""Compile statements. Compilation continues after an error, so that one check finds many errors."""

import struct
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from rosmop.check import call_expressions, loops
from rosmop.check.assignments import write_store
from rosmop.check.call_expressions import convert_value, elements
from rosmop.check.conversion import condition, convert, number
from rosmop.check.expressions import assignment
from rosmop.check.scope import FunctionScope
from rosmop.form import nodes
from rosmop.form.findings import Position, SpecificationError
from rosmop.run.interpreter import constant_of
from rosmop.runtime import numbers
from rosmop.runtime.values import struct_code
from rosmop.text import tree
from rosmop.types import value_types
from rosmop.types.messages import nearest, quote
from rosmop.types.resolve import record, resolve
from roswire import names
from roswire.counted import counted
from roswire.errors import DefinitionError

LARGE = 4096

MAX_TABLE = 64 << 10


def write(scope: FunctionScope, node: tree.Statement) -> None:
    around = len(scope.loops)
    try:
        with scope.at(node):
            _KINDS[type(node)](scope, node)
    except SpecificationError as error:
        scope.shared.findings += error.findings
        del scope.loops[around:]


# Declarations


def _declaration(scope: FunctionScope, node: tree.Declaration) -> None:
    try:
        _declare(scope, node)
    except SpecificationError:
        scope.misdeclared |= {declarator.name for declarator in node.declarators}
        raise


def _declare(scope: FunctionScope, node: tree.Declaration) -> None:
    if node.type.static:
        raise SpecificationError.at(
            node.position, "there are no static variables in functions; declare it before the events"
        )
    for declarator in node.declarators:
        kind, value = initial(scope, node.type, declarator)
        if scope.values.width(kind) > LARGE:
            size = scope.values.width(kind)
            scope.add(nodes.Allocate(scope.lines.site, size))
        variable = scope.local(declarator.name, kind, declarator.position, constant=node.type.constant)
        variable.copied = _is_copy(scope, declarator, kind)
        variable.known = literal_constant(scope, node.type, declarator, kind)
        variable.table = table(scope, node.type, declarator, kind)
        if variable.table is None:
            scope.evaluate(nodes.Assign(kind, variable.code, value))


def _is_copy(scope: FunctionScope, declarator: tree.Declarator, kind: value_types.Type) -> bool:
    if kind != value_types.CHARACTERS or declarator.is_array or not isinstance(declarator.value, tree.Name):
        return False
    return isinstance(scope.value_of(declarator.value).type, value_types.CharactersType)


def table(
    scope: FunctionScope, name: tree.TypeName, declarator: tree.Declarator, kind: value_types.Type
) -> bytes | None:
    given = declarator.value
    if not (
        name.constant and isinstance(kind, value_types.VectorType) and isinstance(given, tree.InitializerList)
    ):
        return None
    code, numbers_of = struct_code(kind.element) or "", list[float]()
    for item in given.items:
        value = None if isinstance(item, tree.InitializerList) else scope.value_of(item)
        if value is None or not isinstance(value.constant, int | float) or len(code) != 1:
            return None
        literal = nodes.Literal(value.type, value.constant)
        numbers_of.append(constant_of(number(literal, kind.element)))
    numbers_of += [0] * ((kind.length or 0) - len(numbers_of))
    raw = struct.pack(f"<{len(numbers_of)}{code}", *numbers_of)
    return raw if len(raw) <= MAX_TABLE else None


def literal_constant(
    scope: FunctionScope, name: tree.TypeName, declarator: tree.Declarator, kind: value_types.Type
) -> bool | int | float | None:
    """Return the value of a `const` literal, which array sizes and cases need, or None."""
    if not name.constant or not value_types.is_number(kind) or declarator.is_array:
        return None
    node = declarator.value
    if node is None and declarator.arguments is not None and len(declarator.arguments) == 1:
        node = declarator.arguments[0]
    if node is None or isinstance(node, tree.InitializerList):
        return None
    value = scope.value_of(node).constant
    if isinstance(kind, value_types.FloatingType):
        return None if value is None or isinstance(value, bytes) else _round(float(value), kind)
    if not isinstance(value, int):
        return None
    return (
        numbers.wrap(value, kind.bits, kind.signed)
        if isinstance(kind, value_types.IntegerType)
        else bool(value)
    )


def _round(value: float, kind: value_types.FloatingType) -> float:
    return value if kind.bits == 64 else numbers.f32(value)


def initial(
    scope: FunctionScope, name: tree.TypeName, declarator: tree.Declarator
) -> tuple[value_types.Type, nodes.Expression]:
    if name.name == ("auto",):
        return _deduce(scope, declarator)
    kind = resolve(name, scope.messages)
    if kind == value_types.VOID:
        raise SpecificationError.at(name.position, "a variable cannot be void")
    if declarator.is_array:
        return _array(scope, kind, declarator)
    if declarator.arguments is not None:
        value = call_expressions.construct(scope, declarator.position, kind, declarator.arguments)
        return kind, convert(scope, value, kind)
    if declarator.value is None:
        return kind, nodes.Zero(kind)
    return kind, convert_value(scope, declarator.value, kind)


def _deduce(scope: FunctionScope, declarator: tree.Declarator) -> tuple[value_types.Type, nodes.Expression]:
    if declarator.value is None or isinstance(declarator.value, tree.InitializerList) or declarator.is_array:
        raise SpecificationError.at(declarator.position, "`auto` needs a value: `auto x = …;`")
    value = scope.value_of(declarator.value)
    if isinstance(value.type, value_types.VoidType | value_types.IteratorType):
        raise SpecificationError.at(
            declarator.position, f"a variable cannot hold {value.type}; use the expression itself"
        )
    kind = value_types.STRING if isinstance(value.type, value_types.CharactersType) else value.type
    return kind, convert(scope, value, kind)


def _array(
    scope: FunctionScope, kind: value_types.Type, declarator: tree.Declarator
) -> tuple[value_types.Type, nodes.Expression]:
    size = _array_size(scope, declarator)
    if kind == value_types.CHAR and not isinstance(declarator.value, tree.InitializerList):
        site, nothing = scope.lines.site, nodes.Literal(value_types.CHAR, 0)
        zeros = nodes.Call(
            value_types.CHARACTERS, "e_repeat", (nodes.Literal(value_types.ULONG, size), nothing), site
        )
        if declarator.value is None:
            return value_types.CHARACTERS, zeros
        text = convert_value(scope, declarator.value, value_types.STRING)
        if size is None:
            return value_types.CHARACTERS, nodes.Call(value_types.CHARACTERS, "t_zeroed", (text,), site)
        if isinstance(declarator.value, tree.StringLiteral) and len(declarator.value.value) >= size:
            length = len(declarator.value.value)
            raise SpecificationError.at(
                declarator.value.position,
                f"a string of {counted(length, 'character')} and its terminating zero need"
                f" `{declarator.name}[{length + 1}]`",
            )
        return value_types.CHARACTERS, nodes.Call(value_types.CHARACTERS, "e_filled", (zeros, text), site)
    if size is None:
        assert isinstance(declarator.value, tree.InitializerList)  # _array_size checks this
        size = len(declarator.value.items)
    array = value_types.VectorType(kind, size)
    if declarator.value is None:
        return array, nodes.Zero(array)
    if not isinstance(declarator.value, tree.InitializerList):
        raise SpecificationError.at(declarator.value.position, "an array is initialised by `{…}`")
    return array, elements(scope, declarator.value, array)


def _array_size(scope: FunctionScope, declarator: tree.Declarator) -> int | None:
    if declarator.size is None:
        if declarator.value is None:
            raise SpecificationError.at(declarator.position, "an array needs a size: `name[3]`")
        return None
    value = scope.value_of(declarator.size)
    size = value.constant
    if not isinstance(size, int) or isinstance(size, bool) or not 0 < size <= 1 << 24:
        raise SpecificationError.at(
            declarator.size.position,
            "the size of an array must be a constant number; write a `std::vector` for other sizes",
        )
    return size


# Expressions and control


def _evaluate(scope: FunctionScope, node: tree.ExpressionStatement) -> None:
    expression = node.expression
    level = call_expressions.stream_of(expression)
    if level is not None:
        scope.evaluate(call_expressions.compile_stream(scope, node, level, expression, headed=True).form)
    elif isinstance(expression, tree.Assignment):
        first, target, assigned = assignment(scope, expression)
        for each in first:
            scope.evaluate(each)
        write_store(scope, target, assigned)
    elif isinstance(expression, tree.IncrementExpression):
        prefix = tree.IncrementExpression(
            expression.position, expression.operator, expression.target, prefix=True
        )
        scope.evaluate(scope.value_of(prefix).form)
    else:
        scope.evaluate(scope.value_of(expression).form)


def _block(scope: FunctionScope, node: tree.Block) -> None:
    with scope.block():
        for statement in node.statements:
            write(scope, statement)


def _if(scope: FunctionScope, node: tree.IfStatement) -> None:
    with scope.at(node.condition):
        test, site = condition(scope.value_of(node.condition)), scope.lines.site
    yes = loops.body(scope, [node.yes], write)
    no = () if node.no is None else loops.body(scope, [node.no], write)
    scope.add(nodes.If(site, test, yes, no))


def _break(scope: FunctionScope, node: tree.Statement) -> None:
    if not scope.loops:
        raise SpecificationError.at(node.position, "`break` is only allowed in a loop or a `switch`")
    scope.add(nodes.Break(scope.lines.site))


def _continue(scope: FunctionScope, node: tree.Statement) -> None:
    loops.write_continue(scope, node.position)


def _return(scope: FunctionScope, node: tree.ReturnStatement) -> None:
    if scope.role == "function":
        _return_value(scope, node)
        return
    if node.value is not None:
        hint = "write `return;` to drop the message" if scope.role == "action" else "write `return;`"
        raise SpecificationError.at(node.value.position, f"there is no caller to return a value to; {hint}")
    if scope.role == "action":
        scope.add(nodes.Drop(scope.lines.site))
    scope.add(nodes.Leave(scope.lines.site, True if scope.role in ("action", "timer") else None))


def _return_value(scope: FunctionScope, node: tree.ReturnStatement) -> None:
    void = isinstance(scope.result, value_types.VoidType)
    if void != (node.value is None):
        hint = (
            "this function returns no value; write `return;`"
            if void
            else f"this function returns {scope.result}"
        )
        raise SpecificationError.at(node.position, hint)
    nothing = nodes.Literal(value_types.VOID, None)
    value = nothing if node.value is None else convert_value(scope, node.value, scope.result)
    scope.add(nodes.Return(scope.lines.site, value, tuple(variable.code for variable in scope.references)))


# Statements that C++ lacks


def _drop(scope: FunctionScope, node: tree.Statement) -> None:
    if scope.handled.drop_refused is not None:
        raise SpecificationError.at(
            node.position, f"`DROP;` is not allowed here: {scope.handled.drop_refused}"
        )
    scope.add(nodes.Drop(scope.lines.site))


def _stop(scope: FunctionScope, node: tree.Statement) -> None:
    if scope.role in ("function", "init"):
        why = "a function has no message" if scope.role == "function" else scope.handled.drop_refused
        raise SpecificationError.at(
            node.position, f"`STOP;` is not allowed here: {why}; write it in an action, a timer or a handler"
        )
    safes = tuple(scope.names.safes.values())
    if not safes and "STOP" not in scope.names.misdeclared:
        text = "`STOP;` sends the safe message, and there is none; declare"
        raise SpecificationError.at(
            node.position, f"{text} `safe package/Type {{ }} on /topic every 100ms;` before the events"
        )
    scope.add(nodes.StopMessage(scope.lines.site, safes))


def _reset(scope: FunctionScope, node: tree.Statement) -> None:
    if scope.role != "handler":
        raise SpecificationError.at(node.position, "`__RESET;` is only allowed in the handlers of a property")
    scope.add(nodes.Reset(scope.lines.site))


def _delete(scope: FunctionScope, node: tree.DeleteStatement) -> None:
    value = scope.value_of(node.target)
    if not isinstance(value.type, value_types.CharactersType):
        raise SpecificationError.at(node.position, f"`delete` is for `char` buffers; {value.type} needs none")


def _publish(scope: FunctionScope, node: tree.PublishStatement) -> None:
    check_topic(node.topic, node.position)
    kind = record(node.type_position, node.type, scope.messages)
    value = scope.value_of(node.value)
    if value.type != kind:
        raise SpecificationError.at(value.position, f"this is {value.type}, but {kind} is published here")
    scope.add(nodes.Publish(scope.lines.site, node.topic, kind, value.form, scope.temporary()))
    scope.note_publication(node.topic, node.type, node.position)


def _call_service(scope: FunctionScope, node: tree.CallStatement) -> None:
    check_topic(node.service, node.position)
    try:
        service = scope.messages.definitions.service(node.type)
    except DefinitionError:
        text = f"unknown service type {quote(node.type)}{nearest(node.type, scope.messages.definitions.service_types)}"
        raise SpecificationError.at(
            node.type_position, f"{text}; others need a .srv file (--msg DIR)"
        ) from None
    kind = value_types.RecordType(service.request.name)
    value = scope.value_of(node.value)
    if value.type != kind:
        raise SpecificationError.at(value.position, f"this is {value.type}, but the request is a {kind}")
    scope.add(nodes.Publish(scope.lines.site, node.service, kind, value.form, scope.temporary(), node.type))
    scope.note_call(node.service, node.type, node.position)


def check_topic(topic: str, position: Position) -> None:
    if not names.is_global_name(topic):
        hint = f"; write `/{topic}`" if names.is_global_name("/" + topic) else "; write for example `/a/b`"
        raise SpecificationError.at(position, f"{quote(topic)} is not a global name{hint}")


_KINDS: Mapping[type[tree.Statement], Callable[[FunctionScope, Any], None]] = {
    tree.Declaration: _declaration,
    tree.ExpressionStatement: _evaluate,
    tree.Block: _block,
    tree.IfStatement: _if,
    tree.WhileStatement: partial(loops.write_while, write=write),
    tree.ForStatement: partial(loops.write_for, write=write),
    tree.RangeForStatement: partial(loops.write_range_for, write=write),
    tree.SwitchStatement: partial(loops.write_switch, write=write),
    tree.BreakStatement: _break,
    tree.ContinueStatement: _continue,
    tree.ReturnStatement: _return,
    tree.DropStatement: _drop,
    tree.StopStatement: _stop,
    tree.ResetStatement: _reset,
    tree.DeleteStatement: _delete,
    tree.PublishStatement: _publish,
    tree.CallStatement: _call_service,
}
