"""What is probably not meant: events no property uses, handlers that never run, properties that say nothing."""

import re
from collections.abc import Sequence
from typing import Protocol

from appliance.rosmop.logics.interface import CompiledProperty
from appliance.rosmop.logics.lint import analyse
from appliance.rosmop.positions import Finding
from appliance.rosmop.syntax import tree
from appliance.rosmop.types.messages import shown

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
