"""Statements that C++ allows and that are hardly meant: an assignment as a condition, a statement without effect."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass

from rosmop.check.call_expressions import stream_of
from rosmop.form.positions import Finding
from rosmop.text import tree


def slips(specification: tree.Specification) -> Iterator[Finding]:
    """Warnings about what is allowed in C++ and is hardly meant: `if (v = 0.8)`, a statement without effect."""
    for node in _nodes(specification):
        if (
            isinstance(node, tree.If | tree.While | tree.For | tree.Conditional)
            and node.condition is not None
        ):
            yield from _assigned(node.condition)
        elif isinstance(node, tree.MessageTrigger) and node.when is not None:
            yield from _assigned(node.when)
        elif isinstance(node, tree.Evaluate) and not _acts(node.expression):
            text = "this statement has no effect; remove it, or assign its value to a variable"
            if isinstance(node.expression, tree.Binary) and node.expression.operator == "==":
                text = "this statement has no effect: `==` compares; to assign write `=`"
            yield Finding(node.position, "warning", text)


def _assigned(condition: tree.Expression) -> Iterator[Finding]:
    """The assignments that are a condition, or a part of one."""
    if isinstance(condition, tree.Assign) and condition.operator == "=":
        text = "`=` assigns, and the condition is the value that was assigned; to compare write `==`"
        yield Finding(condition.position, "warning", text)
    elif isinstance(condition, tree.Unary):
        yield from _assigned(condition.operand)
    elif isinstance(condition, tree.Binary) and condition.operator in ("&&", "||"):
        yield from _assigned(condition.left)
        yield from _assigned(condition.right)


def _acts(expression: tree.Expression) -> bool:
    """Whether an expression may do something: what it calls is not looked at."""
    acting = (tree.Assign, tree.Step, tree.Call, tree.NewCharacters)
    return stream_of(expression) is not None or any(isinstance(node, acting) for node in _nodes(expression))


def _nodes(node: object) -> Iterator[object]:
    """A node and all that are in it."""
    yield node
    if is_dataclass(node):
        for field in fields(node):
            yield from _nodes(getattr(node, field.name))
    elif isinstance(node, tuple):
        for item in node:
            yield from _nodes(item)
