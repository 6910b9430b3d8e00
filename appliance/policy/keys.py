"""The left side of a rule: a resolved ROS name, or a pattern; and the tree that finds the rule of a name.

Patterns, and there are no others:

    /arm/*    one level below /arm
    /arm/**   any depth below /arm, and /arm itself; /** is everything
    /arm*     names of one level that begin so: /arm, /arm2, but not /arm/joint

The most specific key decides, alone: an exact name beats a pattern, a longer literal beginning beats a
shorter one, then `*` beats `**`. With these forms two keys that match a name can only be equally specific by
being the same text, which is a repeated key.

Finding a rule takes one hash look-up for exact names and otherwise one step per level of the name; it does
not depend on the number of rules.
"""

import enum
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from appliance.ros.errors import InvalidNameError
from appliance.ros.names import is_global_name, resolve_parameter

Value = TypeVar("Value")


class Form(enum.IntEnum):
    """The form of a key; the greater one is more specific when the literal beginning is the same."""

    SUBTREE = 0  # /arm/**
    LEVEL = 1  # /arm/*  /arm*
    EXACT = 2  # /arm


class BadKeyError(ValueError):
    """The text is no key; the message says why and what to write instead."""


@dataclass(frozen=True, slots=True)
class Key:
    """A parsed key; `literal` is its text up to the first star."""

    form: Form
    literal: str

    def matches(self, name: str) -> bool:
        """Whether this key speaks of the name (a resolved ROS name)."""
        if self.form is Form.EXACT:
            return name == self.literal
        if self.form is Form.SUBTREE:
            return name.startswith(self.literal) or name + "/" == self.literal
        rest = name.removeprefix(self.literal)
        return name.startswith(self.literal) and "/" not in rest and name != "/"

    @property
    def specificity(self) -> tuple[bool, int, Form]:
        """Of two keys that match a name, the one with the greater specificity decides."""
        return (self.form is Form.EXACT, len(self.literal), self.form)


def parse_key(text: str, *, parameter: bool = False) -> Key:
    """The key that `text` is; raises `BadKeyError`. Parameters have a wider grammar than topics."""
    if not text.startswith("/"):
        raise BadKeyError(f"names here are resolved and begin with a slash: /{text.lstrip('~')}")
    literal, star, rest = text.partition("*")
    if not star:
        return Key(Form.EXACT, _checked(text, literal, parameter))
    if rest == "*" and literal.endswith("/"):
        return Key(Form.SUBTREE, _checked(text, literal, parameter))
    if rest:
        raise BadKeyError("a star may stand at the end only: /arm/* (one level), /arm/** (any depth), /arm*")
    return Key(Form.LEVEL, _checked(text, literal, parameter))


def _checked(text: str, literal: str, parameter: bool) -> str:
    """The literal beginning, once it is known that a resolved name can begin so."""
    name = literal.removesuffix("/") if text.endswith("*") else literal
    if "//" in literal:
        raise BadKeyError(f"can never match: resolved names have single slashes: {_single_slashes(text)}")
    if literal.endswith("/") and text == literal:
        meant = f"{name.rstrip('/')} or {name.rstrip('/')}/**"
        raise BadKeyError(f"can never match: no name ends with a slash; write {meant.strip()}")
    if name and not (is_parameter_key(name) if parameter else is_global_name(name)):
        raise BadKeyError("is not a ROS name: letters, digits and _ between single slashes")
    return literal


def is_parameter_key(text: str) -> bool:
    """Whether `text` is the key of a parameter, or `/`, in its one canonical spelling."""
    try:
        return text.startswith("/") and resolve_parameter(text, "") == text
    except InvalidNameError:
        return False


def _single_slashes(text: str) -> str:
    while "//" in text:
        text = text.replace("//", "/")
    return text


@dataclass(slots=True)
class _Level(Generic[Value]):
    """One level of names: what follows a prefix that ends with a slash."""

    below: dict[str, "_Level[Value]"] = field(default_factory=dict)
    subtree: Value | None = None
    names: list[Value] = field(default_factory=list)
    # Beginnings within this level, longest first; one table per length.
    beginnings: list[tuple[int, dict[str, Value]]] = field(default_factory=list)


class KeyTree(Generic[Value]):
    """Finds the value of the most specific key that matches a name."""

    __slots__ = ("_exact", "_root")

    def __init__(self) -> None:
        self._exact: dict[str, Value] = {}
        self._root: _Level[Value] = _Level()

    def add(self, key: Key, value: Value) -> None:
        """Put a key in; the caller has made sure that no key comes twice."""
        parent, _, beginning = key.literal.rpartition("/")
        level = self._level(parent)
        if key.form is Form.EXACT:
            self._exact[key.literal] = value
            level.names.append(value)
            return
        if key.form is Form.SUBTREE:
            level.subtree = value
            return
        for length, table in level.beginnings:
            if length == len(beginning):
                table[beginning] = value
                return
        level.beginnings.append((len(beginning), {beginning: value}))
        level.beginnings.sort(key=lambda pair: -pair[0])

    def _level(self, parent: str) -> _Level[Value]:
        level = self._root
        for part in parent.split("/")[1:]:
            level = level.below.setdefault(part, _Level())
        return level

    def find(self, name: str) -> Value | None:
        """The value of the most specific key for a resolved name (or `/`, which only `/**` matches)."""
        found = self._exact.get(name)
        if found is not None:
            return found
        level = self._root
        best = level.subtree
        *parents, last = name[1:].split("/")
        for part in parents:
            below = level.below.get(part)
            if below is None:
                return best
            level = below
            if level.subtree is not None:
                best = level.subtree
        return self._find_last(level, last, best)

    @staticmethod
    def _find_last(level: _Level[Value], last: str, best: Value | None) -> Value | None:
        # /arm/** matches /arm itself, and its literal beginning is longer than that of any /arm* or /a*.
        itself = level.below.get(last)
        if itself is not None and itself.subtree is not None:
            return itself.subtree
        if last:
            for length, table in level.beginnings:
                found = table.get(last[:length])
                if found is not None:
                    return found
        return best

    def find_for_subtree(self, name: str) -> Value | None:
        """The value that decides names at any depth below `name` of which no more specific key speaks."""
        level = self._root
        best = level.subtree
        for part in name[1:].split("/") if name != "/" else ():
            below = level.below.get(part)
            if below is None:
                return best
            level = below
            if level.subtree is not None:
                best = level.subtree
        return best

    def below(self, name: str) -> Iterator[Value]:
        """Values of every key that speaks of names below `name` and not of names beside it."""
        level = self._root
        for part in name[1:].split("/") if name != "/" else ():
            found = level.below.get(part)
            if found is None:
                return
            level = found
        waiting = [level]
        while waiting:
            level = waiting.pop()
            if level.subtree is not None:
                yield level.subtree
            yield from level.names
            for _, table in level.beginnings:
                yield from table.values()
            waiting.extend(level.below.values())
