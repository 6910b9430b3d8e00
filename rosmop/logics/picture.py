"""Draw automata, for Graphviz or as SVG, which needs no installed program.

Colours and sizes are attributes, because a content security policy may forbid styles. The column of a state
is its distance from the start.
"""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from rosmop.logics.interface import CompiledProperty, FiniteProperty
from rosmop.logics.pattern import MODES, TimedPattern
from rosmop.logics.property_lint import VerdictGraph, graph_of
from rosmop.logics.tfsm import TimedStateMachine

# Draw the graph of a property's monitor, as data and in the language of Graphviz (``--dot``).


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
        f"digraph {_quote(compiled.logic)} {{",
        "  rankdir=LR;",
        "  node [shape=box, style=rounded];",
        '  start [shape=point, label=""];',
        f"  start -> {diagram.initial};",
    ]
    for number, box in diagram.states.items():
        label = _quote(f"{box.name}\\n{box.other_categories}" if box.other_categories else box.name)
        lines.append(f"  {number} [label={label}{', peripheries=2' if box.double else ''}];")
    lines += [
        f"  {source} -> {target} [label={_quote(events)}];"
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


def _quote(text: str) -> str:
    return '"' + text.replace('"', '\\"') + '"'


_WIDTH, _HEIGHT = 150, 44  # of a state
_COLUMN, _ROW, _MARGIN = 300, 120, 60
_TITLE = 'text-anchor="start" font-weight="bold"'
_EVENT = 'font-size="11" fill="#135"'
_BOX = 'fill="#fff" stroke="#345" stroke-width="1.5"'
_LINE = 'fill="none" stroke="#678" stroke-width="1.3" marker-end="url(#arrow)"'


@dataclass(frozen=True)
class _State:
    name: str
    double: bool
    x: int
    y: int


def dot_of(properties: Sequence[CompiledProperty]) -> str | None:
    graphs = [graph for graph in map(to_dot, properties) if graph is not None]
    return "\n".join(graphs) if graphs else None


def svg_of(properties: Sequence[CompiledProperty]) -> str | None:
    parts: list[str] = []
    top, right = 0, 0
    for compiled in properties:
        diagram = diagram_of(compiled)
        if diagram is None:
            continue
        title = f"{compiled.logic}: {' '.join(compiled.formula.split())[:120]}"
        parts.append(f'<text class="title" x="{_MARGIN}" y="{top + 30}" {_TITLE}>{escape(title)}</text>')
        states = _place(diagram, top + _MARGIN)
        first = states[diagram.initial]
        middle = first.y + _HEIGHT // 2
        parts.append(f'<path class="edge" d="M{first.x - 30} {middle}H{first.x}" {_LINE}/>')
        parts += [
            _edge(states[source], states[target], events)
            for (source, target), events in diagram.edges.items()
        ]
        parts += [_draw(state) for state in states.values()]
        top = max(state.y for state in states.values()) + _ROW
        right = max(right, *(state.x for state in states.values()))
    if not parts:
        return None
    return _document(parts, right + _COLUMN, top)


def _document(parts: Sequence[str], width: int, height: int) -> str:
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
            f'viewBox="0 0 {width} {height}">',
            '<defs><marker id="arrow" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" markerHeight="8" '
            'orient="auto"><path d="M0 0L8 4L0 8z" fill="#678"/></marker></defs>',
            '<g font-family="sans-serif" font-size="13" fill="#222" text-anchor="middle">',
            *parts,
            "</g>",
            "</svg>",
            "",
        ]
    )


def _place(diagram: Diagram, top: int) -> dict[int, _State]:
    distance = {diagram.initial: 0}
    waiting = deque([diagram.initial])
    while waiting:
        current = waiting.popleft()
        for source, target in diagram.edges:
            if source == current and target not in distance:
                distance[target] = distance[current] + 1
                waiting.append(target)
    rows: Counter[int] = Counter()
    states = {}
    for number, box in diagram.states.items():
        column = distance[number]
        x, y = _MARGIN + column * _COLUMN, top + rows[column] * _ROW + (column % 2) * 30 + 30
        rows[column] += 1
        states[number] = _State(" · ".join(filter(None, (box.name, box.other_categories))), box.double, x, y)
    return states


def _draw(state: _State) -> str:
    inner = ""
    if state.double:
        inner = (
            f'<rect class="state" x="{state.x + 4}" y="{state.y + 4}" width="{_WIDTH - 8}" '
            f'height="{_HEIGHT - 8}" rx="7" {_BOX}/>'
        )
    middle = f'x="{state.x + _WIDTH // 2}" y="{state.y + _HEIGHT // 2 + 5}"'
    shown = state.name if len(state.name) <= 22 else state.name[:21] + "…"
    return (
        f'<rect class="state" x="{state.x}" y="{state.y}" width="{_WIDTH}" height="{_HEIGHT}" rx="10" {_BOX}/>{inner}'
        f"<text {middle}><title>{escape(state.name)}</title>{escape(shown)}</text>"
    )


def _edge(at: _State, to: _State, events: str) -> str:
    shown = escape(events)
    if at is to:
        x, y = at.x + _WIDTH // 2, at.y
        path = f"M{x - 20} {y}C{x - 35} {y - 34} {x + 35} {y - 34} {x + 20} {y}"
        return _label(path, x, y - 30, shown)
    if to.x > at.x:
        x1, y1, x2, y2 = at.x + _WIDTH, at.y + _HEIGHT // 2, to.x, to.y + _HEIGHT // 2
        path = f"M{x1} {y1}C{x1 + 60} {y1} {x2 - 60} {y2} {x2} {y2}"
        return _label(path, (x1 + x2) // 2, (y1 + y2) // 2 - 6, shown)
    x1, y1, x2, y2 = at.x + _WIDTH // 2, at.y + _HEIGHT, to.x + _WIDTH // 2, to.y + _HEIGHT
    depth = max(y1, y2) + 40
    return _label(f"M{x1} {y1}C{x1} {depth} {x2} {depth} {x2} {y2}", (x1 + x2) // 2, depth - 6, shown)


def _label(path: str, x: int, y: int, label: str) -> str:
    text = f'<text class="event" x="{x}" y="{y}" {_EVENT}>{label}</text>'
    return f'<path class="edge" d="{path}" {_LINE}/>{text}'
