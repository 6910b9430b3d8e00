"""Find probable mistakes: events no property uses, handlers that never run, properties that say nothing."""

import re
from collections.abc import Sequence
from typing import Protocol

from rosmop.form.compiled import EventCode, PropertyCode
from rosmop.form.positions import Finding
from rosmop.logics.interface import Categories, ClockedProperty, CompiledProperty, FiniteProperty
from rosmop.logics.property_lint import analyse
from rosmop.text import tree
from rosmop.types.messages import shown

_DEFAULT = re.compile(r"[\[,]\s*default\s+[A-Za-z_]")
_WORD = re.compile(r"[A-Za-z_][A-Za-z_0-9]*")


class _HasProperty(Protocol):
    @property
    def property(self) -> CompiledProperty: ...


def lint_property(compiled: CompiledProperty, node: tree.Property) -> list[Finding]:
    """Warnings about a property, each at the handler or formula it is about."""
    handlers = {handler.category: handler.position for handler in node.handlers}
    findings = []
    if not handlers:
        handler = f"`@{compiled.categories[-1]} {{ … }}`"
        text = f"nothing comes of this property: it has no handler; write {handler} behind it"
        findings.append(Finding(node.position, "warning", text))
    for fact in analyse(compiled, [category for category in handlers if category in compiled.categories]):
        position = handlers.get(fact.category) if fact.kind == "never runs" else node.position
        trace = f" (shortest trace: {' '.join(fact.trace)})" if fact.trace else ""
        findings.append(Finding(position or node.position, "warning", fact.text + trace))
    return findings


def kept_slices(
    name: str, events: Sequence[EventCode], properties: Sequence[PropertyCode], nodes: Sequence[tree.Property]
) -> list[Finding]:
    """Warnings about what keeps the slices of a parametric specification for ever."""
    found = [
        Finding(
            event.position,
            "warning",
            f"the slices of {shown(name)} never end: the timer {shown(event.name)} does more than to change their"
            " variables, so each may act again at any time; give the time to a property (`pattern … within`, `tfsm`)",
        )
        for event in events
        if event.period_ns is not None and event.acts
    ]
    for code, node in zip(properties, nodes, strict=True):
        for_good = _for_good(code.property)
        found += [
            Finding(
                handler.position,
                "warning",
                f"@{handler.category} is empty and for good: a binding that comes to it keeps its slice for ever, and"
                " each later event of it is a verdict; leave the handler out",
            )
            for handler in node.handlers
            if handler.category in for_good and not handler.body.statements
        ]
    return found


def _for_good(compiled: CompiledProperty) -> set[str]:
    """The categories of states that are never left."""
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
    return {name for told, stay in zip(verdicts, stays, strict=True) if stay for name in told}


def unused_events(specification: tree.Specification, properties: Sequence[_HasProperty]) -> list[Finding]:
    """Warnings about events that no property names, if there are properties; `default` names all of them."""
    if not properties:
        return []
    named = {word for code in properties for word in _WORD.findall(code.property.formula)}
    if any(code.property.logic == "ptcaret" for code in properties):
        named |= {"begin", "end"}
    if any(
        code.property.logic in ("fsm", "tfsm") and _DEFAULT.search(code.property.formula)
        for code in properties
    ):
        return []
    return [
        Finding(event.position, "warning", f"no property uses the event {shown(event.name)}")
        for event in specification.events
        if event.name not in named
    ]
