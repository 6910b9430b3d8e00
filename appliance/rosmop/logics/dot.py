"""The monitor of a property as a picture, in the language of Graphviz (``--dot``)."""

from appliance.rosmop.logics.interface import CompiledProperty, FiniteProperty
from appliance.rosmop.logics.lint import Graph, graph_of
from appliance.rosmop.logics.pattern import MODES, TimedPattern
from appliance.rosmop.logics.tfsm import TimedMachine


def to_dot(compiled: CompiledProperty) -> str | None:
    """The automaton as a ``digraph``; None if the monitor is not a finite one."""
    graph = graph_of(compiled)
    if graph is None:
        return None
    shown = _reachable(graph)
    lines = [
        f"digraph {_quoted(compiled.logic)} {{",
        "  rankdir=LR;",
        "  node [shape=box, style=rounded];",
        '  start [shape=point, label=""];',
        f"  start -> {graph.initial};",
    ]
    for state in shown:
        told = graph.verdicts[state]
        name = _name(compiled, state)
        more = [category for category in told if category != name]
        label = f"{name}\\n{', '.join(more)}" if more else name
        double = ", peripheries=2" if told and name not in told else ""
        lines.append(f"  {state} [label={_quoted(label)}{double}];")
    for state in shown:
        labels: dict[int, list[str]] = {}
        for trace, target in graph.edges[state]:
            labels.setdefault(target, []).append(" ".join(trace))
        lines += [
            f"  {state} -> {target} [label={_quoted(', '.join(events))}];"
            for target, events in labels.items()
        ]
    return "\n".join([*lines, "}", ""])


def _reachable(graph: Graph) -> list[int]:
    found = {graph.initial: None}
    waiting = [graph.initial]
    while waiting:
        for _, target in graph.edges[waiting.pop()]:
            if target not in found:
                found[target] = None
                waiting.append(target)
    return sorted(found)


def _name(compiled: CompiledProperty, state: int) -> str:
    if isinstance(compiled, FiniteProperty):
        return compiled.automaton.name(state)
    if isinstance(compiled, TimedMachine):
        size = len(compiled.automaton)
        return compiled.automaton.name(compiled.automaton.initial if state == 2 * size else state % size)
    return MODES[state % len(MODES)] if isinstance(compiled, TimedPattern) else str(state)


def _quoted(text: str) -> str:
    return '"' + text.replace('"', '\\"') + '"'
