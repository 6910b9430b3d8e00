"""Decide whether a property can be enforced: by handlers that drop, or by publishing (`enforced by`)."""

from collections.abc import Mapping, Sequence

from rosmop.check.event_functions import compile_acceptance
from rosmop.check.function_bodies import compile_handler, topics_of
from rosmop.check.scope import CompilationContext, SpecificationNames
from rosmop.form import nodes
from rosmop.form.compiled import RemedyCode
from rosmop.form.findings import Position, SpecificationError
from rosmop.logics.interface import CompiledProperty
from rosmop.logics.pattern import ENFORCED, TimedPattern
from rosmop.logics.property_lint import TIME, VerdictGraph, graph_of, shortest_trace_to
from rosmop.text import tree
from rosmop.types.messages import nearest, quote

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
            return f"the timer {quote(event.name)} can make @{category} run, and it has no message to drop"
    return None


def enforcement(
    compiled: CompiledProperty, specification: tree.Specification, handlers: Mapping[str, nodes.Function]
) -> str:
    """Describe how violations of a property without a remedy can be prevented, or which requirement is missing."""
    category = "violation" if "violation" in compiled.categories else "fail"
    graph = graph_of(compiled)
    if graph is not None and shortest_trace_to(compiled, category) is None:
        return f"nothing to enforce: no trace leads to @{category}"
    refused = blocking_refused(compiled, specification, category)
    if refused is None:
        brings = bringing(compiled, graph, category) if graph is not None else compiled.events
        named = ", ".join(event for event in compiled.events if event in brings)
        said = f"can be enforced: @{category} may drop the message that causes it ({named})"
        topics = {
            event.trigger.topic
            for event in specification.events
            if event.name in brings and isinstance(event.trigger, tree.MessageTrigger)
        }
        handler = handlers.get(category)
        if handler is None or not all(_always_suppresses(handler.body, topic) for topic in topics):
            said += f"; to enforce it write `@{category} {{ DROP; }}`"
        return f"{said}; {_COUNTS[compiled.suppresses]}"
    takes = "use an event on a topic instead of the timer"
    if compiled.blocking_refused(category) is not None:
        takes = _TAKES[compiled.logic]
        if isinstance(compiled, TimedPattern):
            refused += f", and no drop makes `{compiled.events[compiled.pattern.second]}` come"
    return f"cannot be enforced by dropping: {refused}; {takes}"


def _always_suppresses(body: Sequence[nodes.Statement], topic: str) -> bool:
    """Whether each path drops the message, or replaces it by the safe one of its topic."""
    for statement in body:
        match statement:
            case nodes.Drop():
                return True
            case nodes.StopMessage(safes=safes) if any(safe.topic == topic for safe in safes):
                return True
            case nodes.If(yes=yes, no=no) if _always_suppresses(yes, topic) and _always_suppresses(no, topic):
                return True
        if any(isinstance(node, nodes.Leave) for node in nodes.walk(statement)):
            return False
    return False


_COUNTS = {
    True: "a dropped message does not count for it",
    False: "a dropped message counts for it, as if it had been passed on",
}


def bringing(compiled: CompiledProperty, graph: VerdictGraph, category: str) -> set[str]:
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


def remedy_code(
    shared: CompilationContext,
    names: SpecificationNames,
    specification: tree.Specification,
    compiled: CompiledProperty,
    node: tree.Property,
) -> RemedyCode | None:
    """Compile what `enforced by` names. Raises `SpecificationError` if it cannot publish the awaited message."""
    if not isinstance(compiled, TimedPattern) or (name := compiled.remedy) is None:
        return None
    place = place_of_remedy(compiled)
    function = names.functions.get(name)
    if function is None:
        if name in names.misdeclared:
            raise SpecificationError(())
        raise SpecificationError.at(place, f"unknown function {quote(name)}{nearest(name, names.functions)}")
    if function.parameters:
        raise SpecificationError.at(place, f"{quote(name)} takes parameters; at a deadline there are none")
    topics = topics_of(names, name)
    if not topics:
        raise SpecificationError.at(place, f"{quote(name)} publishes nothing; write `PUBLISH(…)` in it")
    awaited = compiled.events[compiled.pattern.second]
    number, event = next(
        (number, one) for number, one in enumerate(specification.events) if one.name == awaited
    )
    trigger = event.trigger
    if not isinstance(trigger, tree.MessageTrigger) or trigger.part is not None:
        what = "a timer" if isinstance(trigger, tree.TimerTrigger) else "an event of a service"
        text = f"{quote(awaited)} is {what}, so no message that {quote(name)} publishes is the due one"
        raise SpecificationError.at(place, f"{text}; await an event on a topic")
    if trigger.topic not in topics:
        text = f"{quote(name)} publishes {', '.join(topics)}, but the due message {quote(awaited)} is on"
        raise SpecificationError.at(place, f"{text} {trigger.topic}; publish it there")
    at = node.position
    call = tree.ExpressionStatement(at, tree.CallExpression(at, tree.Name(at, (name,)), ()))
    handler = tree.Handler(at, ENFORCED[0], tree.Block(at, (call,)))
    called = compile_handler(shared, names, handler, "a deadline has no message to drop")
    return RemedyCode(name, called, number, compile_acceptance(shared, names, event))


def place_of_remedy(compiled: CompiledProperty) -> Position:
    return compiled.source.finding(compiled.formula.rindex(compiled.remedy or ""), "").position


def with_remedy(compiled: CompiledProperty, node: tree.Property) -> list[tree.Handler]:
    """Return the handlers; with a remedy also of `enforced`, so that slices wait for the deadline."""
    handlers = list(node.handlers)
    if compiled.remedy is None or any((handler.category,) == ENFORCED for handler in handlers):
        return handlers
    return [*handlers, tree.Handler(node.position, ENFORCED[0], tree.Block(node.position, ()))]
