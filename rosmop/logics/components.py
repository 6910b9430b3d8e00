"""Strongly connected components of a graph (Tarjan), without recursion."""

from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import TypeVar

Node = TypeVar("Node", bound=Hashable)


def strong_components(
    nodes: Iterable[Node], successors: Callable[[Node], Iterable[Node]]
) -> list[list[Node]]:
    """The components, each after all those that it leads to."""
    index: dict[Node, int] = {}
    low: dict[Node, int] = {}
    open_nodes: dict[Node, None] = {}
    components: list[list[Node]] = []
    for root in nodes:
        if root in index:
            continue
        path: list[tuple[Node, Iterator[Node]]] = []
        current: Node | None = root
        while current is not None or path:
            if current is not None:
                index[current] = low[current] = len(index)
                open_nodes[current] = None
                path.append((current, iter(successors(current))))
            node, rest = path[-1]
            current = None
            for target in rest:
                if target not in index:
                    current = target
                    break
                if target in open_nodes:
                    low[node] = min(low[node], index[target])
            if current is not None:
                continue
            path.pop()
            if path:
                parent = path[-1][0]
                low[parent] = min(low[parent], low[node])
            if low[node] == index[node]:
                component = []
                while True:
                    member, _ = open_nodes.popitem()
                    component.append(member)
                    if member == node:
                        break
                components.append(component)
    return components
