"""What can be said of a property before it runs: handlers that never run, and verdicts that are always the
same.

Only what is certain is told. Of a grammar that needs a stack, of a formula with several time bounds, and of one about
the future with bounds, nothing is told.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from rosmop.logics.interface import Categories, CompiledProperty, FiniteProperty
from rosmop.logics.past_monitors import ClockedPast
from rosmop.logics.pattern import TimedPattern
from rosmop.logics.tfsm import TimedMachine

TIME = "<time>"
"""Stands in a trace for the passing of a deadline or of the time bound."""

_VIOLATION = {"ltl": "violation", "ptltl": "violation", "mtl": "violation", "pattern": "violation"}
_FAILURE = {"ere": "fail", "cfg": "fail"}


@dataclass(frozen=True)
class Fact:
    """Something certain about a property. ``trace`` is a shortest trace that shows it, where there is one."""

    kind: Literal["never runs", "never violated", "violated at once"]
    category: str
    text: str
    trace: tuple[str, ...] | None = None


@dataclass(frozen=True)
class Graph:
    """States, what leads from one to the next, and what is told on entering each."""

    initial: int
    edges: tuple[tuple[tuple[tuple[str, ...], int], ...], ...]
    verdicts: tuple[Categories, ...]


def analyse(compiled: CompiledProperty, handled: Sequence[str]) -> list[Fact]:
    """The facts about a property whose handlers are for the categories ``handled``."""
    graph = graph_of(compiled)
    if graph is None:
        return []
    traces = _shortest_traces(graph)
    facts = [
        Fact("never runs", category, f"no trace leads to `{category}`: the handler @{category} never runs")
        for category in dict.fromkeys(handled)
        if category not in traces
    ]
    violation = _VIOLATION.get(compiled.logic)
    if violation is not None and violation not in traces and compiled.remedy is None:
        facts.append(Fact("never violated", violation, "no trace violates this property"))
    category = violation or _FAILURE.get(compiled.logic)
    firsts = [(trace, state) for trace, state in graph.edges[graph.initial] if trace[0] != TIME]
    if category is not None and all(category in graph.verdicts[state] for _, state in firsts):
        word = "violated" if category == "violation" else "failed"
        text = f"the property is {word} at the first event, whatever it is"
        facts.append(Fact("violated at once", category, text, firsts[0][0]))
    return facts


def shortest_trace_to(compiled: CompiledProperty, category: str) -> tuple[str, ...] | None:
    """The events of a shortest trace after which the property is in a category; None if none is known.

    ``TIME`` among them means that a deadline or a time bound passes.
    """
    graph = graph_of(compiled)
    return None if graph is None else _shortest_traces(graph).get(category)


def _shortest_traces(graph: Graph) -> dict[str, tuple[str, ...]]:
    """For each category that a trace can lead to, a shortest one."""
    found: dict[str, tuple[str, ...]] = {}
    traces: dict[int, tuple[str, ...]] = {graph.initial: ()}
    waiting = deque([graph.initial])
    while waiting:
        state = waiting.popleft()
        for label, target in graph.edges[state]:
            trace = traces[state] + label
            for category in graph.verdicts[target]:
                found.setdefault(category, trace)
            if target not in traces:
                traces[target] = trace
                waiting.append(target)
    return found


def graph_of(compiled: CompiledProperty) -> Graph | None:
    """The states of a property and what leads from one to the next, or None if they are not finitely many."""
    if isinstance(compiled, FiniteProperty):
        automaton = compiled.automaton
        labels = [(event,) for event in compiled.events]
        edges = tuple(tuple(zip(labels, row, strict=True)) for row in automaton.table)
        return Graph(automaton.initial, edges, automaton.verdicts)
    if isinstance(compiled, TimedMachine):
        return _machine_graph(compiled)
    if isinstance(compiled, TimedPattern):
        return _pattern_graph(compiled)
    if isinstance(compiled, ClockedPast):
        return _past_graph(compiled)
    return None


def _past_graph(compiled: ClockedPast) -> Graph:
    """Each state before the time bound has passed since the clock began, and each after that."""
    size = len(compiled.moves)
    late = [
        [
            (name, target if anew else size + target)
            for name, (target, anew) in zip(compiled.events, row, strict=True)
        ]
        for row in compiled.late
    ]
    early = (
        (
            *(((name,), target) for name, (target, _anew) in zip(compiled.events, row, strict=True)),
            *(((TIME, name), target) for name, target in after),
        )
        for row, after in zip(compiled.moves, late, strict=True)
    )
    after = (tuple(((name,), target) for name, target in row) for row in late)
    return Graph(compiled.initial, (*early, *after), (*compiled.verdicts, *compiled.verdicts))


def _machine_graph(compiled: TimedMachine) -> Graph:
    """Each state by event, each after a timeout, and the start (which no event has led to)."""
    base = compiled.automaton
    size = len(base)
    silent = compiled.silence_ns is not None
    labels = [(event,) for event in compiled.events]
    by_event = [tuple(zip(labels, row, strict=True)) for row in base.table]
    timeouts = [
        (((TIME,), size + (state if timeout is None else timeout[1])),)
        if silent or timeout is not None
        else ()
        for state, timeout in enumerate(compiled.timeouts)
    ]
    clocked = [events + timeout for events, timeout in zip(by_event, timeouts, strict=True)]
    after_timeout = by_event if silent else clocked
    start = (by_event if silent else clocked)[base.initial]
    told = tuple(("timeout",) if silent else ("timeout", *verdict) for verdict in base.verdicts)
    return Graph(2 * size, (*clocked, *after_timeout, start), (*base.verdicts, *told, ()))


def _pattern_graph(compiled: TimedPattern) -> Graph:
    """The modes; with a remedy each also as it is entered by that.

    Where no deadline is waited for, an event may still come too late for the time bound.
    """
    edges = []
    size = len(compiled.expiries) if compiled.at_expiry else 0
    for mode, expiry in enumerate(compiled.expiries):
        row: list[tuple[tuple[str, ...], int]] = []
        for event, name in enumerate(compiled.events):
            row.append(((name,), compiled.moves[mode][event][0]))
            if expiry is None:
                row.append(((TIME, name), compiled.late[mode][event][0]))
        if expiry is not None:
            row.append(((TIME,), size + expiry))
        edges.append(tuple(row))
    told = tuple((*compiled.at_expiry, *verdict) for verdict in compiled.verdicts)
    initial = compiled.initial
    if not size:
        return Graph(initial, tuple(edges), told)
    return Graph(initial, (*edges, *edges), (*compiled.verdicts, *told))
