"""Find probable mistakes: unused events, handlers that never run, properties and statements without effect."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Protocol

from rosmop.check.call_expressions import stream_of
from rosmop.form.compiled import EventCode, PropertyCode
from rosmop.form.findings import Diagnostic, Position
from rosmop.logics.catalogue import LOGICS
from rosmop.logics.interface import Categories, ClockedProperty, CompiledProperty, FiniteProperty
from rosmop.logics.property_lint import analyse
from rosmop.run.state import MAX_STATE_BYTES
from rosmop.runtime.action_context import MAX_BYTES
from rosmop.text import tree
from rosmop.types.messages import quote

_DEFAULT = re.compile(r"[\[,]\s*+default\s++[A-Za-z_]")
_WITHOUT_UNIT = re.compile(
    r"\b((?:within|timeout)\s+(\d+(?:\.\d+)?))(?![\d.]|\s*[num]?s\b|\s*(?:m|h|min|us)\b)"
)
_BOUND_WITHOUT_UNIT = re.compile(r"[\[,]\s*((\d+(?:\.\d+)?))(?=\s*[,\]])")
_WORD = re.compile(r"[A-Za-z_][A-Za-z_0-9]*+")


class _HasProperty(Protocol):
    @property
    def property(self) -> CompiledProperty: ...


def lint_size(size: int, position: Position) -> Iterator[Diagnostic]:
    if size > MAX_BYTES:
        text = f"the variables take {size} bytes; a specification may hold {MAX_BYTES >> 20} MiB"
        yield Diagnostic(position, "error", text)
    elif size > MAX_STATE_BYTES:
        text = f"the variables take {size} bytes; a state of more than {MAX_STATE_BYTES >> 10} KiB is not kept, so"
        yield Diagnostic(position, "warning", f"{text} a restart of the relay loses it")


def lint_property(compiled: CompiledProperty, node: tree.Property) -> list[Diagnostic]:
    handlers = {handler.category: handler.position for handler in node.handlers}
    findings = []
    if not handlers:
        handler = f"`@{compiled.categories[-1]} {{ … }}`"
        text = f"this property has no effect without a handler; write {handler} after it"
        findings.append(Diagnostic(node.position, "warning", text))
    without = [*_WITHOUT_UNIT.finditer(compiled.formula)]
    if compiled.logic == "mtl":
        without += (bound for bound in _BOUND_WITHOUT_UNIT.finditer(compiled.formula) if float(bound[1]))
    for bound in without:
        text = f"`{bound[1]}` has no unit, so it is {bound[2]} s; write `{bound[2]}s` or `{bound[2]}ms`"
        findings.append(replace(compiled.source.finding(bound.start(1), text), severity="warning"))
    for fact in analyse(compiled, [category for category in handlers if category in compiled.categories]):
        position = handlers.get(fact.category) if fact.kind == "never runs" else node.position
        trace = f" (shortest trace: {' '.join(fact.trace)})" if fact.trace else ""
        findings.append(Diagnostic(position or node.position, "warning", fact.text + trace))
    return findings


def kept_slices(
    name: str, events: Sequence[EventCode], properties: Sequence[PropertyCode], nodes: Sequence[tree.Property]
) -> list[Diagnostic]:
    slices = [
        Diagnostic(
            event.position,
            "warning",
            f"the slices of {quote(name)} never end: the timer {quote(event.name)} does more than change their"
            " variables, so each may act again at any time;"
            " put the time limit into a property (`pattern … within`, `tfsm`)",
        )
        for event in events
        if event.period_ns is not None and event.acts
    ]
    for code, node in zip(properties, nodes, strict=True):
        for_good = _for_good(code.property)
        slices += [
            Diagnostic(
                handler.position,
                "warning",
                f"@{handler.category} is empty and permanent: a binding that reaches it keeps its slice forever, and"
                " each later event is a verdict; leave the handler out",
            )
            for handler in node.handlers
            if handler.category in for_good and not handler.body.statements
        ]
    return slices


def _for_good(compiled: CompiledProperty) -> set[str]:
    verdicts: Sequence[Categories]
    if isinstance(compiled, FiniteProperty):
        automaton = compiled.automaton
        stays = [{*row} == {state} for state, row in enumerate(automaton.table)]
        verdicts = automaton.verdicts
    elif isinstance(compiled, ClockedProperty):
        verdicts = compiled.verdicts
        stays = [
            wait is None and {target for target, _ in (*early, *late)} == {state}
            for state, (early, late, wait) in enumerate(
                zip(compiled.moves, compiled.late, compiled.waits, strict=True)
            )
        ]
    else:
        return set()
    return {name for categories, stay in zip(verdicts, stays, strict=True) if stay for name in categories}


def unused_events(specification: tree.Specification, properties: Sequence[_HasProperty]) -> list[Diagnostic]:
    """Find unused events. A `default` counts as a use of every event, and without properties nothing is reported."""
    if not properties:
        return []
    named = {word for code in properties for word in _WORD.findall(code.property.formula)}
    for code in properties:
        logic = LOGICS[code.property.logic]
        if logic.has_states and _DEFAULT.search(code.property.formula):
            return []
        named.update(logic.implicit_events)
    return [
        Diagnostic(event.position, "warning", f"no property uses the event {quote(event.name)}")
        for event in specification.events
        if event.name not in named
    ]


def lint_statements(specification: tree.Specification) -> Iterator[Diagnostic]:
    for node in tree.walk(specification):
        if (
            isinstance(
                node, tree.IfStatement | tree.WhileStatement | tree.ForStatement | tree.ConditionalExpression
            )
            and node.condition is not None
        ):
            yield from _assigned(node.condition)
        elif isinstance(node, tree.MessageTrigger) and node.when is not None:
            yield from _assigned(node.when)
        elif isinstance(node, tree.ExpressionStatement) and not _acts(node.expression):
            text = "this statement has no effect; remove it, or assign its value to a variable"
            if isinstance(node.expression, tree.BinaryExpression) and node.expression.operator == "==":
                text = "this statement has no effect: `==` compares; to assign write `=`"
            yield Diagnostic(node.position, "warning", text)


def _assigned(condition: tree.Expression) -> Iterator[Diagnostic]:
    if isinstance(condition, tree.Assignment) and condition.operator == "=":
        text = "`=` assigns, and the condition is the value that was assigned; to compare write `==`"
        yield Diagnostic(condition.position, "warning", text)
    elif isinstance(condition, tree.UnaryExpression):
        yield from _assigned(condition.operand)
    elif isinstance(condition, tree.BinaryExpression) and condition.operator in ("&&", "||"):
        yield from _assigned(condition.left)
        yield from _assigned(condition.right)


def _acts(expression: tree.Expression) -> bool:
    acting = (tree.Assignment, tree.IncrementExpression, tree.CallExpression, tree.NewExpression)
    return stream_of(expression) is not None or any(
        isinstance(node, acting) for node in tree.walk(expression)
    )
