"""Statements. One function for each kind of statement of `syntax/tree.py`.

A statement that is refused is noted and the next one is looked at, so that one check finds as much as it can.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from rosmop.check import call_expressions, loops
from rosmop.check.assignments import write_store
from rosmop.check.conversion import condition, convert
from rosmop.check.expressions import assignment
from rosmop.check.initializers import converted, elements
from rosmop.check.scope import Scope
from rosmop.form import nodes
from rosmop.form.positions import Position
from rosmop.runtime import numbers
from rosmop.text import tree
from rosmop.text.errors import SpecificationError
from rosmop.types import value_types
from rosmop.types.messages import shown
from rosmop.types.resolve import record, resolve
from roswire import names

LARGE = 4096
"""A local variable of so many bytes is charged when it is declared."""


def write(scope: Scope, node: tree.Statement) -> None:
    """Write the lines of a statement."""
    around = len(scope.loops)
    try:
        with scope.at(node):
            _KINDS[type(node)](scope, node)
    except SpecificationError as error:
        scope.shared.findings += error.findings
        del scope.loops[around:]


# Declarations


def _declaration(scope: Scope, node: tree.Declaration) -> None:
    try:
        _declare(scope, node)
    except SpecificationError:
        scope.misdeclared |= {declarator.name for declarator in node.declarators}
        raise


def _declare(scope: Scope, node: tree.Declaration) -> None:
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
        variable.known = known(scope, node.type, declarator, kind)
        scope.evaluate(nodes.Assign(kind, variable.code, value))


def _is_copy(scope: Scope, declarator: tree.Declarator, kind: value_types.Type) -> bool:
    """Whether a `char *` begins with the characters of another one."""
    if kind != value_types.CHARACTERS or declarator.is_array or not isinstance(declarator.value, tree.Name):
        return False
    return isinstance(scope.value_of(declarator.value).type, value_types.Characters)


def known(
    scope: Scope, name: tree.TypeName, declarator: tree.Declarator, kind: value_types.Type
) -> bool | int | float | None:
    """The value of a `const` number whose value is written down, for sizes of arrays and cases; None for others."""
    if not name.constant or not value_types.is_number(kind) or declarator.is_array:
        return None
    node = declarator.value
    if node is None and declarator.arguments is not None and len(declarator.arguments) == 1:
        node = declarator.arguments[0]
    if node is None or isinstance(node, tree.Elements):
        return None
    value = scope.value_of(node).constant
    if isinstance(kind, value_types.Floating):
        return None if value is None or isinstance(value, bytes) else _rounded(float(value), kind)
    if not isinstance(value, int):
        return None
    return (
        numbers.wrap(value, kind.bits, kind.signed) if isinstance(kind, value_types.Integer) else bool(value)
    )


def _rounded(value: float, kind: value_types.Floating) -> float:
    return value if kind.bits == 64 else numbers.f32(value)


def initial(
    scope: Scope, name: tree.TypeName, declarator: tree.Declarator
) -> tuple[value_types.Type, nodes.Expression]:
    """The type of a declared variable, and its first value."""
    if name.name == ("auto",):
        return _deduced(scope, declarator)
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
    return kind, converted(scope, declarator.value, kind)


def _deduced(scope: Scope, declarator: tree.Declarator) -> tuple[value_types.Type, nodes.Expression]:
    if declarator.value is None or isinstance(declarator.value, tree.Elements) or declarator.is_array:
        raise SpecificationError.at(declarator.position, "`auto` needs a value: `auto x = …;`")
    value = scope.value_of(declarator.value)
    if isinstance(value.type, value_types.Void | value_types.Index):
        raise SpecificationError.at(
            declarator.position, f"a variable cannot hold {value.type}; use the expression itself"
        )
    kind = value_types.STRING if isinstance(value.type, value_types.Characters) else value.type
    return kind, convert(scope, value, kind)


def _array(
    scope: Scope, kind: value_types.Type, declarator: tree.Declarator
) -> tuple[value_types.Type, nodes.Expression]:
    size = _array_size(scope, declarator)
    if kind == value_types.CHAR and not isinstance(declarator.value, tree.Elements):
        site, nothing = scope.lines.site, nodes.Literal(value_types.CHAR, 0)
        zeros = nodes.Call(
            value_types.CHARACTERS, "e_repeat", (nodes.Literal(value_types.ULONG, size), nothing), site
        )
        if declarator.value is None:
            return value_types.CHARACTERS, zeros
        text = converted(scope, declarator.value, value_types.STRING)
        if size is None:
            return value_types.CHARACTERS, nodes.Call(value_types.CHARACTERS, "t_zeroed", (text,))
        if isinstance(declarator.value, tree.Text) and len(declarator.value.value) >= size:
            length = len(declarator.value.value)
            raise SpecificationError.at(
                declarator.value.position,
                f"a text of {length} characters and its zero need `{declarator.name}[{length + 1}]`",
            )
        return value_types.CHARACTERS, nodes.Call(value_types.CHARACTERS, "e_filled", (zeros, text), site)
    if size is None:
        assert isinstance(declarator.value, tree.Elements)  # _array_size has looked
        size = len(declarator.value.items)
    array = value_types.Vector(kind, size)
    if declarator.value is None:
        return array, nodes.Zero(array)
    if not isinstance(declarator.value, tree.Elements):
        raise SpecificationError.at(declarator.value.position, "an array is initialised by `{…}`")
    return array, elements(scope, declarator.value, array)


def _array_size(scope: Scope, declarator: tree.Declarator) -> int | None:
    if declarator.size is None:
        if declarator.value is None:
            raise SpecificationError.at(declarator.position, "an array needs a size: `name[3]`")
        return None
    value = scope.value_of(declarator.size)
    size = value.constant
    if not isinstance(size, int) or isinstance(size, bool) or not 0 < size <= 1 << 24:
        raise SpecificationError.at(
            declarator.size.position,
            "the size of an array is a number; write a `std::vector` for another size",
        )
    return size


# Expressions and control


def _evaluate(scope: Scope, node: tree.Evaluate) -> None:
    expression = node.expression
    level = call_expressions.stream_of(expression)
    if level is not None:
        scope.evaluate(call_expressions.streamed(scope, node, level, expression, headed=True).form)
    elif isinstance(expression, tree.Assign):
        first, target, assigned = assignment(scope, expression)
        for each in first:
            scope.evaluate(each)
        write_store(scope, target, assigned)
    elif isinstance(expression, tree.Step):
        prefix = tree.Step(expression.position, expression.operator, expression.target, prefix=True)
        scope.evaluate(scope.value_of(prefix).form)
    else:
        scope.evaluate(scope.value_of(expression).form)


def _block(scope: Scope, node: tree.Block) -> None:
    with scope.block():
        for statement in node.statements:
            write(scope, statement)


def _if(scope: Scope, node: tree.If) -> None:
    with scope.at(node.condition):
        test, site = condition(scope.value_of(node.condition)), scope.lines.site
    yes = loops.body(scope, [node.yes], write)
    no = () if node.no is None else loops.body(scope, [node.no], write)
    scope.add(nodes.If(site, test, yes, no))


def _break(scope: Scope, node: tree.Statement) -> None:
    if not scope.loops:
        raise SpecificationError.at(node.position, "`break` stands in a loop or a `switch`")
    scope.add(nodes.Break(scope.lines.site))


def _continue(scope: Scope, node: tree.Statement) -> None:
    loops.write_continue(scope, node.position)


def _return(scope: Scope, node: tree.Return) -> None:
    if scope.role == "function":
        _return_value(scope, node)
        return
    if node.value is not None:
        hint = "write `return;` to drop the message" if scope.role == "action" else "write `return;`"
        raise SpecificationError.at(node.value.position, f"there is nobody to return a value to; {hint}")
    if scope.role == "action":
        scope.add(nodes.Drop(scope.lines.site, anyway=True))
    scope.add(nodes.Leave(scope.lines.site, True if scope.role in ("action", "timer") else None))


def _return_value(scope: Scope, node: tree.Return) -> None:
    void = isinstance(scope.result, value_types.Void)
    if void != (node.value is None):
        hint = (
            "this function has no value; write `return;`" if void else f"this function returns {scope.result}"
        )
        raise SpecificationError.at(node.position, hint)
    nothing = nodes.Literal(value_types.VOID, None)
    value = nothing if node.value is None else converted(scope, node.value, scope.result)
    scope.add(nodes.Return(scope.lines.site, value, tuple(variable.code for variable in scope.references)))


# What only specifications have


def _drop(scope: Scope, node: tree.Statement) -> None:
    if scope.drop_refused is not None:
        raise SpecificationError.at(node.position, f"`DROP;` cannot stand here: {scope.drop_refused}")
    scope.add(nodes.Drop(scope.lines.site, anyway=scope.role != "handler"))  # a timeout has no message


def _reset(scope: Scope, node: tree.Statement) -> None:
    if scope.role != "handler":
        raise SpecificationError.at(node.position, "`__RESET;` stands in the handlers of a property")
    scope.add(nodes.Reset(scope.lines.site))


def _delete(scope: Scope, node: tree.Delete) -> None:
    value = scope.value_of(node.target)
    if not isinstance(value.type, value_types.Characters):
        raise SpecificationError.at(node.position, f"`delete` is for `char` buffers; {value.type} needs none")


def _publish(scope: Scope, node: tree.Publish) -> None:
    check_topic(node.topic, node.position)
    kind = record(node.type_position, node.type, scope.messages)
    value = scope.value_of(node.value)
    if value.type != kind:
        raise SpecificationError.at(value.position, f"this is {value.type}, but {kind} is to be published")
    scope.add(nodes.Publish(scope.lines.site, node.topic, kind, value.form, scope.temporary()))
    scope.published(node.topic, node.type, node.position)


def check_topic(topic: str, position: Position) -> None:
    """Refuse the name of a topic or service that is not global and canonical."""
    if not names.is_global_name(topic):
        hint = f"; write `/{topic}`" if names.is_global_name("/" + topic) else "; write for example `/a/b`"
        raise SpecificationError.at(position, f"{shown(topic)} is no global name{hint}")


_KINDS: Mapping[type[tree.Statement], Callable[[Scope, Any], None]] = {
    tree.Declaration: _declaration,
    tree.Evaluate: _evaluate,
    tree.Block: _block,
    tree.If: _if,
    tree.While: partial(loops.write_while, write=write),
    tree.For: partial(loops.write_for, write=write),
    tree.RangeFor: partial(loops.write_range_for, write=write),
    tree.Switch: partial(loops.write_switch, write=write),
    tree.Break: _break,
    tree.Continue: _continue,
    tree.Return: _return,
    tree.Drop: _drop,
    tree.Reset: _reset,
    tree.Delete: _delete,
    tree.Publish: _publish,
}
