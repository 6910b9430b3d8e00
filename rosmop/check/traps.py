"""Warn of valid code that passes an unsafe message, or stops a safe one, against its author's likely intention."""

from collections.abc import Iterator, Sequence
from heapq import heappop, heappush
from ipaddress import ip_address
from itertools import combinations

from rosmop.form.findings import Diagnostic, SpecificationError
from rosmop.text import tree
from rosmop.types.messages import nearest, quote

# Order the specifications of a set by their phases and by `order` statements.
#
# Without them they keep the order of the text. A phase or statement moves a specification after those that come before
# it, no further than necessary.

Phases = frozenset[tuple[str, str]]

NAMED = ("stops", "drops", "limits", "watches", "smooths", "follows")
"""The phases of specifications that have one (`name() in limits { … }`), in their order."""


def phases_of(
    orders: Sequence[tree.OrderStatement], specifications: Sequence[tree.Specification] = ()
) -> Phases:
    """Return all pairs that phases and statements order. Raises `SpecificationError` for a cycle."""
    behind: dict[str, set[str]] = {}
    placed = [(one.name, _place(one.phase)) for one in specifications if one.phase is not None]
    for first, place in placed:
        behind[first] = {second for second, other in placed if place < other}
    for order in orders:
        names = [name.parts[0] for name in order.names]
        for place, name in enumerate(names):
            behind.setdefault(name, set()).update(names[place + 1 :])
    pairs = frozenset((first, second) for first in behind for second in _reachable(behind, first))
    for order in orders:
        for word in order.names:
            if (word.parts[0], word.parts[0]) in pairs:
                text = f"{quote(word.parts[0])} would come before itself; leave out an `order` statement or a phase"
                raise SpecificationError.at(word.position, text)
    return pairs


def _place(phase: tree.Name) -> int:
    name = phase.parts[0]
    if name not in NAMED:
        text = f"there is no phase {quote(name)}{nearest(name, NAMED)}"
        raise SpecificationError.at(phase.position, text)
    return NAMED.index(name)


def _reachable(behind: dict[str, set[str]], name: str) -> set[str]:
    found: set[str] = set()
    waiting = [name]
    while waiting:
        further = behind.get(waiting.pop(), set()) - found
        found |= further
        waiting += further
    return found


def evaluation_order(names: Sequence[str], phases: Phases) -> list[int]:
    places: dict[str, list[int]] = {}
    for place, name in enumerate(names):
        places.setdefault(name, []).append(place)
    behind: dict[int, list[int]] = {}
    waits = [0] * len(names)
    for first, second in phases:
        for place in places.get(first, ()):
            behind.setdefault(place, []).extend(places.get(second, ()))
        for place in places.get(second, ()):
            waits[place] += len(places.get(first, ()))
    ready = [place for place, number in enumerate(waits) if not number]  # in ascending order, so it is a heap
    found = []
    while ready:
        found.append(heappop(ready))
        for place in behind.get(found[-1], ()):
            waits[place] -= 1
            if not waits[place]:
                heappush(ready, place)
    return found


def unknown_phases(orders: Sequence[tree.OrderStatement], names: Sequence[str]) -> Iterator[Diagnostic]:
    for order in orders:
        for name in order.names:
            if name.parts[0] not in names:
                text = f"no specification is named {quote(name.parts[0])}{nearest(name.parts[0], names)}"
                yield Diagnostic(
                    name.position, "warning", f"{text}; `order` has no effect on it until one is loaded"
                )


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
                    text = f"{quote(event.name)} {text} call it from another event"
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
        return f"the name of a node begins with `/`, so this is never equal; write {quote('/' + text)}"
    if function != "host" or not text:
        return ""
    try:
        plain = str(ip_address(text))
    except ValueError:
        why = "`host` is an address such as 10.0.0.7, and never a name or a group"
        return f"{why}, so this is never equal; write the address of {quote(text)}"
    return (
        ""
        if plain == text
        else f"`host` has this address as {quote(plain)}, so this is never equal; write that"
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
