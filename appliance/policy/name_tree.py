"""Find the most specific key of a name: exact names by hash, patterns in a tree of levels.

If stars are only at the end of keys, a look-up takes one step per level of the name, whatever the number of keys. Keys
with an earlier star make the search branch; the compiler bounds their number.

Invariants: `find` returns the value of the key with the greatest `specificity` among those that match (the tests
compare the two); the caller adds no key twice, and none that ties with another.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from appliance.policy.keys import Key, levels

Value = TypeVar("Value")


@dataclass(slots=True)
class _Node(Generic[Value]):
    """A node of the tree: `value` for a key that ends here; `subtree` for one that ends with `/**`."""

    names: dict[str, "_Node[Value]"] = field(default_factory=dict)
    # Beginnings of a level, longest first; one table per length.
    stars: list[tuple[int, dict[str, "_Node[Value]"]]] = field(default_factory=list)
    value: tuple[Key, Value] | None = None
    subtree: tuple[Key, Value] | None = None

    def starred(self, level: str) -> Iterator["_Node[Value]"]:
        """Yield the nodes behind the stars that match a level, longest beginning first."""
        for length, table in self.stars:
            node = table.get(level[:length])
            if node is not None:
                yield node

    def children(self) -> Iterator["_Node[Value]"]:
        yield from self.names.values()
        for _, table in self.stars:
            yield from table.values()


class KeyTree(Generic[Value]):
    """A tree that finds the value of the most specific key that matches a name."""

    __slots__ = ("_exact", "_root")

    def __init__(self) -> None:
        self._exact: dict[str, Value] = {}
        self._root: _Node[Value] = _Node()

    def add(self, key: Key, value: Value) -> None:
        """Add a key."""
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
        """Return the value of the most specific key for a resolved name (`/` is matched by `/**` only)."""
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
        """Return the values of the specific keys that decide some names below `name`."""
        inherited, ends = self._walk(name)
        prefix = "/" if name == "/" else name + "/"
        found = [pair for end in ends for child in end.children() for pair in _everything(child)]
        if inherited is not None:
            found = [pair for pair in found if pair[0].specificity > inherited[0].specificity]
            if inherited[0].literal.startswith(prefix):
                found.append(inherited)
        return [value for _, value in found]

    def inherited(self, name: str) -> Value | None:
        """Return the value for the names below `name` that have no more specific key."""
        inherited, _ = self._walk(name)
        return inherited[1] if inherited is not None else None

    def _walk(self, name: str) -> tuple[tuple[Key, Value] | None, list[_Node[Value]]]:
        """Return the most specific `/**` key that includes all of `/name/**`, and the nodes that `name` leads to."""
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
    """Return the best pattern for a name whose first levels lead through `path` without a star.

    Literal beginnings grow along the path, so its end is tried first. In one node the stars come before
    `subtree`: a longer beginning of a level beats a shorter one, and of /x/* and /x/**, equally long, the
    first wins.
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
    """Return the best pattern behind a star: all have the same literal beginning, so at most one of a kind fits."""
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
