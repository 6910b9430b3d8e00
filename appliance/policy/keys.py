"""The left side of a rule (a resolved ROS name, or a pattern), and the tree that finds the key for a name.

The forms of keys, and their order, are in docs/reference/policy-file.md. Two keys tie if they are equally specific
and match the same name; a policy with a tie is rejected.

A look-up takes one step per level of the name, whatever the number of keys with stars only at their end.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from appliance.policy.ini_reader import Word
from appliance.policy.policy_findings import Findings, quote
from roswire.errors import InvalidNameError
from roswire.names import is_global_name, resolve_parameter

Step = tuple[str, bool]
"""One level of a key: its text, and whether a star follows it."""


class BadKeyError(ValueError):
    """A key is invalid; the message gives the reason and the correct form."""


@dataclass(frozen=True, slots=True)
class Key:
    """A key; `subtree`: it includes everything below the last level (`/**`)."""

    text: str
    steps: tuple[Step, ...]
    subtree: bool

    @property
    def literal(self) -> str:
        return self.text.partition("*")[0]

    @property
    def exact(self) -> bool:
        return "*" not in self.text

    @property
    def specificity(self) -> tuple[bool, int, bool]:
        """The rank among matching keys, of which the greatest decides."""
        return (self.exact, len(self.literal), not self.subtree)

    @property
    def inner_star(self) -> bool:
        """Whether a star is before the end, as in `/*/state` or `/arm*/**`; only such keys can tie."""
        return any(star for _, star in (self.steps if self.subtree else self.steps[:-1]))

    def matches(self, name: str) -> bool:
        if self.exact:
            return name == self.text
        parts = levels(name)
        if len(parts) < len(self.steps) or (len(parts) > len(self.steps) and not self.subtree):
            return False
        return all(
            part.startswith(text) if star else part == text
            for (text, star), part in zip(self.steps, parts, strict=False)
        )

    def ties_with(self, other: "Key") -> bool:
        if self.specificity != other.specificity:
            return False
        if len(self.steps) != len(other.steps) and not self.subtree:
            return False
        return all(map(_compatible, self.steps, other.steps))


def _compatible(step: Step, other: Step) -> bool:
    (text, star), (other_text, other_star) = step, other
    fits = star and other_text.startswith(text)
    return fits or (other_star and text.startswith(other_text)) or text == other_text


def levels(name: str) -> list[str]:
    return name[1:].split("/") if name != "/" else []


def parse_key(text: str, *, parameter: bool = False) -> Key:
    """Return the key of a name or pattern; parameters' names have a wider grammar. Raises `BadKeyError`."""
    if not text.startswith("/"):
        raise BadKeyError(f"names here are resolved and begin with a slash: /{text.lstrip('~')}")
    if "//" in text:
        raise BadKeyError(f"can never match: resolved names have single slashes: {_single_slashes(text)}")
    if text.endswith("/"):
        meant = f"{text[:-1]} or {text[:-1]}/**" if text != "/" else "/**"
        raise BadKeyError(f"can never match: no resolved name ends with a slash; write {meant}")
    parts = text[1:].split("/")
    subtree = parts[-1] == "**"
    steps = tuple((part.removesuffix("*"), part.endswith("*")) for part in parts[: -1 if subtree else None])
    if any("*" in step for step, _ in steps):
        raise BadKeyError("a star may only be at the end of a level, and ** only as the whole last level")
    # Check the key as a name. A level that is only a star matches any name, so replace it by x.
    name = "".join(f"/{step or 'x'}" for step, _ in steps) or "/x"
    if not (is_parameter_key(name) if parameter else is_global_name(name)):
        raise BadKeyError("is not a ROS name: letters, digits and _ between single slashes")
    return Key(text, steps, subtree)


def ties(key: Key, word: Word, earlier: list[tuple[Key, int]], findings: Findings) -> bool:
    """Return whether the key ties with an earlier one, which is an error; add it to the earlier ones."""
    for other, line in earlier:
        if key.ties_with(other):
            both = f"{quote(word.text)} and {quote(other.text)} (line {line})"
            text = f"{both} are equally specific and match the same names: change one of them"
            findings.error(word, text)
            return True
    earlier.append((key, word.line))
    return False


def command_key(name: str) -> Key:
    return Key(name, (), subtree=False)


def is_parameter_key(text: str) -> bool:
    try:
        return text.startswith("/") and resolve_parameter(text, "") == text
    except InvalidNameError:
        return False


def _single_slashes(text: str) -> str:
    while "//" in text:
        text = text.replace("//", "/")
    return text


Value = TypeVar("Value")


@dataclass(slots=True)
class _Node(Generic[Value]):
    """A node of the tree: `value` belongs to a key that ends here, `subtree` to a key that goes on with `/**`."""

    names: dict[str, "_Node[Value]"] = field(default_factory=dict)
    # The literal beginnings of levels with a star: one table for each length, longest first.
    stars: list[tuple[int, dict[str, "_Node[Value]"]]] = field(default_factory=list)
    value: tuple[Key, Value] | None = None
    subtree: tuple[Key, Value] | None = None

    def starred_nodes(self, level: str) -> Iterator["_Node[Value]"]:
        for length, table in self.stars:
            node = table.get(level[:length])
            if node is not None:
                yield node

    def children(self) -> Iterator["_Node[Value]"]:
        yield from self.names.values()
        for _, table in self.stars:
            yield from table.values()


class KeyTree(Generic[Value]):
    """Finds the value of the most specific key that matches a name. No key is added twice, or ties with another."""

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
        """Return the values of keys that decide only some of the names below `name`."""
        inherited, ends = self._walk(name)
        prefix = "/" if name == "/" else name + "/"
        found = [pair for end in ends for child in end.children() for pair in _everything(child)]
        if inherited is not None:
            found = [pair for pair in found if pair[0].specificity > inherited[0].specificity]
            if inherited[0].literal.startswith(prefix):
                found.append(inherited)
        return [value for _, value in found]

    def inherited_value(self, name: str) -> Value | None:
        """Return the value for names below `name` that no more specific key matches."""
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
    yield from node.starred_nodes(level)


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

    Literal beginnings grow along the path, so the end of the path is tried first. In each node, stars are tried
    before `subtree`, because a longer literal beginning beats a shorter one, and /x/* beats /x/**.
    """
    for depth in range(len(path) - 1, -1, -1):
        node = path[depth]
        if node.stars and depth < len(parts):
            for child in node.starred_nodes(parts[depth]):
                found = _find_behind_star(child, parts, depth + 1)
                if found is not None:
                    return found
        if node.subtree is not None:
            return node.subtree
    return None


def _find_behind_star(node: _Node[Value], parts: list[str], depth: int) -> tuple[Key, Value] | None:
    """Return the best pattern after a star.

    All patterns here have the same literal beginning, so at most one with `/**` matches, and at most one without.
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
