"""Find certain facts about a property before it runs, such as handlers that never run and constant verdicts.

A grammar that needs a stack has none, nor has a formula with several time bounds or with bounds about the
future.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Literal

from rosmop.logics.catalogue import LOGICS
from rosmop.logics.interface import Categories, CompiledProperty, FiniteProperty
from rosmop.logics.past_monitors import ClockedPastProperty
from rosmop.logics.pattern import TimedPattern
from rosmop.logics.tfsm import TimedStateMachine

TIME = "<time>"


@dataclass(frozen=True)
class PropertyFact:
    """A certain fact. ``trace`` is a shortest trace that shows it, or None."""

    kind: Literal["never runs", "never violated", "violated at once"]
    category: str
    text: str
    trace: tuple[str, ...] | None = None


@dataclass(frozen=True)
class VerdictGraph:
    """A graph of states; ``verdicts`` are the categories on entering each."""

    initial: int
    edges: tuple[tuple[tuple[tuple[str, ...], int], ...], ...]
    verdicts: tuple[Categories, ...]


def analyse(compiled: CompiledProperty, handled: Sequence[str]) -> list[PropertyFact]:
    graph = graph_of(compiled)
    if graph is None:
        return []
    traces = _shortest_traces(graph)
    facts = [
        PropertyFact(
            "never runs", category, f"no trace leads to `{category}`: the handler @{category} never runs"
        )
        for category in dict.fromkeys(handled)
        if category not in traces
    ]
    category = LOGICS[compiled.logic].failure
    if category == "violation" and category not in traces and compiled.remedy is None:
        facts.append(PropertyFact("never violated", category, "no trace violates this property"))
    if (
        category is not None
        and _always(graph, category)
        and _always(graph_of(_with_another(compiled)), category)
    ):
        word = "violated" if category == "violation" else "failed"
        text = f"the property is {word} at the first event, whatever it is"
        facts.append(PropertyFact("violated at once", category, text, compiled.events[:1]))
    return facts


def _always(graph: VerdictGraph | None, category: str) -> bool:
    """Whether each first event leads to the category, at whatever time it comes."""
    if graph is None:
        return False
    firsts = [state for trace, state in graph.edges[graph.initial] if trace != (TIME,)]
    return all(category in graph.verdicts[state] for state in firsts)


def _with_another(compiled: CompiledProperty) -> CompiledProperty:
    """Return the property among the same events and one that the formula does not name.

    `globally: no e` depends on the event, even if `e` is the only one so far.
    """
    name = next(name for number in count() if (name := f"other{number}") not in compiled.events)
    return LOGICS[compiled.logic].compile(replace(compiled.source, events=(*compiled.events, name)))


def shortest_trace_to(compiled: CompiledProperty, category: str) -> tuple[str, ...] | None:
    graph = graph_of(compiled)
    return None if graph is None else _shortest_traces(graph).get(category)


def _shortest_traces(graph: VerdictGraph) -> dict[str, tuple[str, ...]]:
    shortest_traces: dict[str, tuple[str, ...]] = {}
    traces: dict[int, tuple[str, ...]] = {graph.initial: ()}
    waiting = deque([graph.initial])
    while waiting:
        state = waiting.popleft()
        for label, target in graph.edges[state]:
            trace = traces[state] + label
            for category in graph.verdicts[target]:
                shortest_traces.setdefault(category, trace)
            if target not in traces:
                traces[target] = trace
                waiting.append(target)
    return shortest_traces


def graph_of(compiled: CompiledProperty) -> VerdictGraph | None:
    if isinstance(compiled, FiniteProperty):
        automaton = compiled.automaton
        labels = [(event,) for event in compiled.events]
        edges = tuple(tuple(zip(labels, row, strict=True)) for row in automaton.table)
        return VerdictGraph(automaton.initial, edges, automaton.verdicts)
    if isinstance(compiled, TimedStateMachine):
        return _machine_graph(compiled)
    if isinstance(compiled, TimedPattern):
        return _pattern_graph(compiled)
    if isinstance(compiled, ClockedPastProperty):
        return _past_graph(compiled)
    return None


def _past_graph(compiled: ClockedPastProperty) -> VerdictGraph:
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
    return VerdictGraph(compiled.initial, (*early, *after), (*compiled.verdicts, *compiled.verdicts))


def _machine_graph(compiled: TimedStateMachine) -> VerdictGraph:
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
    late_verdicts = tuple(("timeout",) if silent else ("timeout", *verdict) for verdict in base.verdicts)
    return VerdictGraph(2 * size, (*clocked, *after_timeout, start), (*base.verdicts, *late_verdicts, ()))


def _pattern_graph(compiled: TimedPattern) -> VerdictGraph:
    """Return a graph; with a remedy, each mode has a second node, which the remedy enters, and a third one, which
    it enters if no due message came.

    In a mode without a deadline, an event may still come too late for the time bound.
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
        if expiry is not None and size:
            row.append(((TIME,), 2 * size + expiry))
        edges.append(tuple(row))
    late_verdicts = tuple((*compiled.at_expiry, *verdict) for verdict in compiled.verdicts)
    initial = compiled.initial
    if not size:
        return VerdictGraph(initial, tuple(edges), late_verdicts)
    return VerdictGraph(
        initial, (*edges, *edges, *edges), (*compiled.verdicts, *late_verdicts, *[("violation",)] * size)
    )
