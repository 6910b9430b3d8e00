"""Warn of valid code that passes an unsafe message, or stops a safe one, against its author's likely intention."""

from collections.abc import Iterator, Sequence
from ipaddress import ip_address
from itertools import combinations

from rosmop.check.phases import Phases
from rosmop.form.findings import Diagnostic
from rosmop.text import tree
from rosmop.types.messages import shown


def traps(specification: tree.Specification) -> Iterator[Diagnostic]:
    yield from _unlike_a_sender(specification)
    for event in specification.events:
        if isinstance(event.trigger, tree.TimerTrigger) and not event.trigger.has_unit:
            period = f"{event.trigger.period_ns / 1e9:g}"
            text = f"`every` without a unit is {period} s; write `{period}s` or `{period}ms`"
            yield Diagnostic(event.trigger.position, "warning", text)
        yield from _called_again(event)


def _called_again(event: tree.EventDefinition) -> Iterator[Diagnostic]:
    match event.trigger:
        case tree.MessageTrigger(part="request" | "response", topic=service):
            for node in tree.walk(event.action):
                if isinstance(node, tree.CallStatement) and node.service == service:
                    text = f"calls {service}, and happens with each call of it: it calls without end;"
                    text = f"{shown(event.name)} {text} call it from another event"
                    yield Diagnostic(node.position, "warning", text)


def _unlike_a_sender(specification: tree.Specification) -> Iterator[Diagnostic]:
    own = {function.name for function in specification.functions}
    for node in tree.walk(specification):
        match node:
            case (
                tree.BinaryExpression(operator="==" | "!=", left=call, right=tree.StringLiteral() as text)
                | tree.BinaryExpression(operator="==" | "!=", left=tree.StringLiteral() as text, right=call)
            ) if isinstance(call, tree.CallExpression) and isinstance(call.callee, tree.Name):
                if call.callee.parts[-1] not in own and (
                    wrong := _wrong_sender(call.callee.parts[-1], text.value.decode("utf-8", "replace"))
                ):
                    yield Diagnostic(text.position, "warning", wrong)


def _wrong_sender(function: str, text: str) -> str:
    if function == "caller" and text and not text.startswith("/"):
        return f"the name of a node begins with `/`, so this is never equal; write {shown('/' + text)}"
    if function != "host" or not text:
        return ""
    try:
        plain = str(ip_address(text))
    except ValueError:
        why = "`host` is an address such as 10.0.0.7, and never a name or a group"
        return f"{why}, so this is never equal; write the address of {shown(text)}"
    return (
        ""
        if plain == text
        else f"`host` has this address as {shown(plain)}, so this is never equal; write that"
    )


def _assigned(statement: tree.ExpressionStatement) -> str:
    target = statement.expression
    if not isinstance(target, tree.Assignment):
        return ""
    place: object = target.target
    while not isinstance(place, tree.Name):
        if not isinstance(place, tree.SyntaxNode):
            return ""
        place = tree.fields_of(place)[1]
    return place.parts[0]


def _assigned_in(statement: tree.Statement) -> set[str]:
    return {_assigned(node) for node in tree.walk(statement) if isinstance(node, tree.ExpressionStatement)}


def rival_changes(specifications: Sequence[tree.Specification], phases: Phases) -> Iterator[Diagnostic]:
    """Warn of fields that two specifications change, where the later decides. Pairs in `phases` are intended."""
    changed = [
        (specification, topic, field, binding)
        for specification in specifications
        for topic, field, binding in _changes(specification)
    ]
    seen: set[tuple[str, str, str]] = set()
    for (first, topic, one, _), (second, there, other, binding) in combinations(changed, 2):
        same = one == other or one.startswith(f"{other}.") or other.startswith(f"{one}.")
        key = first.name, second.name, topic
        if (first.name, second.name) in phases:
            continue
        if first is not second and topic == there and same and key not in seen:
            seen.add(key)
            text = f"{first.name} also changes {other} of {topic}; the order of the files decides: {second.name} has"
            text = f"{text} the last word; write `order {first.name} < {second.name};`, or the reverse"
            yield Diagnostic(binding.position, "warning", text)


def _changes(specification: tree.Specification) -> Iterator[tuple[str, str, tree.Binding]]:
    for event in specification.events:
        if isinstance(event.trigger, tree.MessageTrigger):
            assigned = _assigned_in(event.action)
            for binding in event.trigger.pattern:
                if binding.variable in assigned:
                    path = ".".join(
                        step.name if step.index is None else f"{step.name}[{step.index}]"
                        for step in binding.path
                    )
                    yield event.trigger.topic, path, binding
