"""Decide whether a property can be enforced: by handlers that drop, or by publishing (`enforced by`)."""

from collections.abc import Collection, Sequence
from dataclasses import replace

from rosmop.check.function_bodies import topics_of
from rosmop.check.scope import SpecificationNames
from rosmop.form.findings import SpecificationError
from rosmop.logics.interface import CompiledProperty
from rosmop.logics.pattern import ENFORCED, TimedPattern
from rosmop.logics.property_lint import TIME, VerdictGraph, graph_of, shortest_trace_to
from rosmop.text import tree
from rosmop.types.messages import nearest, shown

_TAKES = {
    "pattern": "write `enforced by f` after `within`, with a function f that publishes the due message",
    "mtl": "write a `pattern: … causes … within … enforced by f`, with a function f that publishes the due message",
}


def blocking_refused(
    compiled: CompiledProperty, specification: tree.Specification, category: str
) -> str | None:
    """Return the reason why a handler cannot drop the message that caused its verdict, or None if it can."""
    refused = compiled.blocking_refused(category)
    if refused is not None:
        return refused
    for index, event in enumerate(specification.events):
        if isinstance(event.trigger, tree.TimerTrigger) and category in compiled.categories_after(index):
            return f"the timer {shown(event.name)} can cause @{category}, and it has no message to drop"
    return None


def enforcement(
    compiled: CompiledProperty,
    specification: tree.Specification,
    published: Sequence[str],
    dropping: Collection[str],
) -> str:
    """Describe how violations of a property can be prevented, or which requirement is missing.

    `published` are the topics of its remedy, `dropping` the categories whose handlers drop the message.
    """
    if compiled.remedy is not None:
        topics = ", ".join(published)
        return f"enforced: at the deadline {compiled.remedy} publishes the due message ({topics})"
    category = "violation" if "violation" in compiled.categories else "fail"
    graph = graph_of(compiled)
    if graph is not None and shortest_trace_to(compiled, category) is None:
        return f"nothing to enforce: no trace leads to @{category}"
    refused = blocking_refused(compiled, specification, category)
    if refused is None:
        brings = _bringing(compiled, graph, category) if graph is not None else compiled.events
        named = ", ".join(event for event in compiled.events if event in brings)
        said = f"can be enforced: @{category} may drop the message that causes it ({named})"
        if category not in dropping:
            said += f"; to enforce it write `@{category} {{ DROP; }}`"
        return f"{said}; {_COUNTS[compiled.suppresses]}"
    takes = "use an event on a topic instead of the timer"
    if compiled.blocking_refused(category) is not None:
        takes = _TAKES[compiled.logic]
        if isinstance(compiled, TimedPattern):
            refused += f", and no drop makes `{compiled.events[compiled.pattern.second]}` come"
    return f"cannot be enforced by dropping: {refused}; {takes}"


_COUNTS = {
    True: "a dropped message does not count for it",
    False: "a dropped message counts for it, as if it had been passed on",
}


def _bringing(compiled: CompiledProperty, graph: VerdictGraph, category: str) -> set[str]:
    """Return the events that lead to the category from a state without it.

    If dropped messages do not count, only states that other messages reach are considered.
    """
    reached, brings = {graph.initial}, set[str]()
    waiting = [graph.initial]
    while waiting:
        state = waiting.pop()
        for trace, target in graph.edges[state]:
            leads = category in graph.verdicts[target]
            if leads and (state == graph.initial or category not in graph.verdicts[state]):
                brings.add(trace[-1])
            if target not in reached and not (leads and compiled.suppresses and trace[-1] != TIME):
                reached.add(target)
                waiting.append(target)
    return brings


def topics_of_remedy(names: SpecificationNames, compiled: CompiledProperty) -> list[str]:
    name = compiled.remedy
    if name is None:
        return []
    place = compiled.source.finding(compiled.formula.rindex(name), "").position
    function = names.functions.get(name)
    if function is None:
        if name in names.misdeclared:
            raise SpecificationError(())
        raise SpecificationError.at(place, f"unknown function {shown(name)}{nearest(name, names.functions)}")
    if function.parameters:
        raise SpecificationError.at(place, f"{shown(name)} takes parameters; at a deadline there are none")
    topics = topics_of(names, name)
    if not topics:
        raise SpecificationError.at(place, f"{shown(name)} publishes nothing; write `PUBLISH(…)` in it")
    return topics


def with_remedy(compiled: CompiledProperty, node: tree.Property) -> list[tree.Handler]:
    handlers = list(node.handlers)
    if compiled.remedy is None:
        return handlers
    at = node.position
    call = tree.ExpressionStatement(at, tree.CallExpression(at, tree.Name(at, (compiled.remedy,)), ()))
    mine = [place for place, handler in enumerate(handlers) if (handler.category,) == ENFORCED]
    for place in mine:
        body = handlers[place].body
        handlers[place] = replace(handlers[place], body=replace(body, statements=(call, *body.statements)))
    return handlers if mine else [*handlers, tree.Handler(at, ENFORCED[0], tree.Block(at, (call,)))]
