"""Find the most specific key that matches a name: exact names by hash, patterns in a tree of levels.

If stars are only at the end of keys, a look-up takes one step per level of the name, whatever the number of keys. A
key with an earlier star makes the search branch; the compiler limits the number of such keys.

Invariants:

1. `find` returns the value of the matching key with the greatest `specificity` (compared by tests).
2. The caller does not add a key twice, and does not add a key that ties with another key.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from appliance.policy.keys import Key, levels

Value = TypeVar("Value")


@dataclass(slots=True)
class _Node(Generic[Value]):
    """`value` belongs to a key that ends here, `subtree` to one that ends here with `/**`."""

    names: dict[str, "_Node[Value]"] = field(default_factory=dict)
    # The literal beginnings of levels with a star: one table for each length, longest first.
    stars: list[tuple[int, dict[str, "_Node[Value]"]]] = field(default_factory=list)
    value: tuple[Key, Value] | None = None
    subtree: tuple[Key, Value] | None = None

    def starred(self, level: str) -> Iterator["_Node[Value]"]:
        """The longest literal beginning comes first."""
        for length, table in self.stars:
            node = table.get(level[:length])
            if node is not None:
                yield node

    def children(self) -> Iterator["_Node[Value]"]:
        yield from self.names.values()
        for _, table in self.stars:
            yield from table.values()


class KeyTree(Generic[Value]):
    """Finds the value of the most specific key that matches a name."""

    __slots__ = ("_exact", "_root")

    def __init__(self) -> None:
        self._exact: dict[str, Value] = {}
        self._root: _Node[Value] = _Node()

    def add(self, key: Key, value: Value) -> None:
        if key.exact:
            self._exact[key.text] = value
        node = self._root
        for text, star in key.steps:
            node = _starred_child(node, text) if star else node.names.setdefault(text, _Node())
        if key.subtree:
            node.subtree = (key, value)
        elif key.steps:
            node.value = (key, value)

    def find(self, name: str) -> Value | None:
        """The name is resolved; only `/**` matches `/`."""
        found = self._exact.get(name)
        if found is not None:
            return found
        parts = levels(name)
        path = [self._root]
        for part in parts:
            child = path[-1].names.get(part)
            if child is None:
                break
            path.append(child)
        pattern = _find(path, parts)
        return pattern[1] if pattern is not None else None

    def below(self, name: str) -> list[Value]:
        """These keys decide only some of the names below `name`."""
        inherited, ends = self._walk(name)
        prefix = "/" if name == "/" else name + "/"
        found = [pair for end in ends for child in end.children() for pair in _everything(child)]
        if inherited is not None:
            found = [pair for pair in found if pair[0].specificity > inherited[0].specificity]
            if inherited[0].literal.startswith(prefix):
                found.append(inherited)
        return [value for _, value in found]

    def inherited(self, name: str) -> Value | None:
        """The key decides names below `name` that no more specific key matches."""
        inherited, _ = self._walk(name)
        return inherited[1] if inherited is not None else None

    def _walk(self, name: str) -> tuple[tuple[Key, Value] | None, list[_Node[Value]]]:
        reached = [self._root]
        subtrees = [self._root.subtree]
        for level in levels(name):
            reached = [child for node in reached for child in _next(node, level)]
            subtrees.extend(node.subtree for node in reached)
        there = [pair for pair in subtrees if pair is not None]
        return max(there, key=lambda pair: pair[0].specificity, default=None), reached


def _starred_child(node: _Node[Value], beginning: str) -> _Node[Value]:
    for length, table in node.stars:
        if length == len(beginning):
            return table.setdefault(beginning, _Node())
    child: _Node[Value] = _Node()
    node.stars.append((len(beginning), {beginning: child}))
    node.stars.sort(key=lambda pair: -pair[0])
    return child


def _next(node: _Node[Value], level: str) -> Iterator[_Node[Value]]:
    child = node.names.get(level)
    if child is not None:
        yield child
    yield from node.starred(level)


def _everything(node: _Node[Value]) -> Iterator[tuple[Key, Value]]:
    waiting = [node]
    while waiting:
        node = waiting.pop()
        if node.value is not None:
            yield node.value
        if node.subtree is not None:
            yield node.subtree
        waiting.extend(node.children())


def _find(path: list[_Node[Value]], parts: list[str]) -> tuple[Key, Value] | None:
    """The first levels of the name lead through `path` without a star.

    Literal beginnings grow along the path, so the end of the path is tried first. In each node, stars are tried
    before `subtree`, because a longer literal beginning beats a shorter one, and /x/* beats /x/**.
    """
    for depth in range(len(path) - 1, -1, -1):
        node = path[depth]
        if node.stars and depth < len(parts):
            for child in node.starred(parts[depth]):
                found = _find_behind_star(child, parts, depth + 1)
                if found is not None:
                    return found
        if node.subtree is not None:
            return node.subtree
    return None


def _find_behind_star(node: _Node[Value], parts: list[str], depth: int) -> tuple[Key, Value] | None:
    """Return the best pattern behind a star.

    All patterns here have the same literal beginning. So at most one pattern with `/**` matches, and at most one
    without.
    """
    waiting = [(node, depth)]
    subtree: tuple[Key, Value] | None = None
    while waiting:
        node, depth = waiting.pop()
        if node.subtree is not None:
            subtree = node.subtree
        if depth < len(parts):
            waiting.extend((child, depth + 1) for child in _next(node, parts[depth]))
        elif node.value is not None:
            return node.value
    return subtree
