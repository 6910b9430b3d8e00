"""Draw automata, for Graphviz or as SVG, which needs no installed program.

Colours and sizes are attributes, because a content security policy may forbid styles. The column of a state
is its distance from the start.
"""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from rosmop.logics.dot import Diagram, diagram_of, to_dot
from rosmop.logics.interface import CompiledProperty

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
        states = _placed(diagram, top + _MARGIN)
        first = states[diagram.initial]
        middle = first.y + _HEIGHT // 2
        parts.append(f'<path class="edge" d="M{first.x - 30} {middle}H{first.x}" {_LINE}/>')
        parts += [
            _edge(states[source], states[target], events)
            for (source, target), events in diagram.edges.items()
        ]
        parts += [_drawn(state) for state in states.values()]
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


def _placed(diagram: Diagram, top: int) -> dict[int, _State]:
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


def _drawn(state: _State) -> str:
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
        return _labelled(path, x, y - 30, shown)
    if to.x > at.x:
        x1, y1, x2, y2 = at.x + _WIDTH, at.y + _HEIGHT // 2, to.x, to.y + _HEIGHT // 2
        path = f"M{x1} {y1}C{x1 + 60} {y1} {x2 - 60} {y2} {x2} {y2}"
        return _labelled(path, (x1 + x2) // 2, (y1 + y2) // 2 - 6, shown)
    x1, y1, x2, y2 = at.x + _WIDTH // 2, at.y + _HEIGHT, to.x + _WIDTH // 2, to.y + _HEIGHT
    depth = max(y1, y2) + 40
    return _labelled(f"M{x1} {y1}C{x1} {depth} {x2} {depth} {x2} {y2}", (x1 + x2) // 2, depth - 6, shown)


def _labelled(path: str, x: int, y: int, label: str) -> str:
    text = f'<text class="event" x="{x}" y="{y}" {_EVENT}>{label}</text>'
    return f'<path class="edge" d="{path}" {_LINE}/>{text}'
