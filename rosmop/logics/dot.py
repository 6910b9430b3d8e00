"""Draw the graph of a property's monitor, as data and in the language of Graphviz (``--dot``)."""

from dataclasses import dataclass

from rosmop.logics.interface import CompiledProperty, FiniteProperty
from rosmop.logics.pattern import MODES, TimedPattern
from rosmop.logics.property_lint import VerdictGraph, graph_of
from rosmop.logics.tfsm import TimedStateMachine


@dataclass(frozen=True)
class Box:
    """A drawn state, with a single or a double border."""

    name: str
    other_categories: str
    double: bool


@dataclass(frozen=True)
class Diagram:
    """The reachable states by number, with the events that lead from one to another."""

    initial: int
    states: dict[int, Box]
    edges: dict[tuple[int, int], str]


def diagram_of(compiled: CompiledProperty) -> Diagram | None:
    graph = graph_of(compiled)
    if graph is None:
        return None
    states: dict[int, Box] = {}
    edges: dict[tuple[int, int], list[str]] = {}
    for state in _reachable(graph):
        categories = graph.verdicts[state]
        name = _name(compiled, state)
        more = ", ".join(category for category in categories if category != name)
        states[state] = Box(name, more, bool(categories) and name not in categories)
        for trace, target in graph.edges[state]:
            edges.setdefault((state, target), []).append(" ".join(trace))
    return Diagram(graph.initial, states, {ends: ", ".join(events) for ends, events in edges.items()})


def to_dot(compiled: CompiledProperty) -> str | None:
    diagram = diagram_of(compiled)
    if diagram is None:
        return None
    lines = [
        f"digraph {_quoted(compiled.logic)} {{",
        "  rankdir=LR;",
        "  node [shape=box, style=rounded];",
        '  start [shape=point, label=""];',
        f"  start -> {diagram.initial};",
    ]
    for number, box in diagram.states.items():
        label = _quoted(f"{box.name}\\n{box.other_categories}" if box.other_categories else box.name)
        lines.append(f"  {number} [label={label}{', peripheries=2' if box.double else ''}];")
    lines += [
        f"  {source} -> {target} [label={_quoted(events)}];"
        for (source, target), events in diagram.edges.items()
    ]
    return "\n".join([*lines, "}", ""])


def _reachable(graph: VerdictGraph) -> list[int]:
    found = {graph.initial}
    waiting = [graph.initial]
    while waiting:
        for _, target in graph.edges[waiting.pop()]:
            if target not in found:
                found.add(target)
                waiting.append(target)
    return sorted(found)


def _name(compiled: CompiledProperty, state: int) -> str:
    if isinstance(compiled, FiniteProperty):
        return compiled.automaton.name(state)
    if isinstance(compiled, TimedStateMachine):
        size = len(compiled.automaton)
        return compiled.automaton.name(compiled.automaton.initial if state == 2 * size else state % size)
    return MODES[state % len(MODES)] if isinstance(compiled, TimedPattern) else str(state)


def _quoted(text: str) -> str:
    return '"' + text.replace('"', '\\"') + '"'
