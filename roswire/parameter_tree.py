"""The parameter tree of `rosmaster`: lookups by key, and values that block a key."""

from collections.abc import Iterator, Mapping
from functools import lru_cache

from roswire.xmlrpc import Value

Tree = dict[str, Value]


@lru_cache(256)
def parts_of(key: str) -> tuple[str, ...]:
    return tuple([part for part in key.split("/") if part])


def holds_others(value: Value) -> bool:
    """Return whether a value is a non-empty namespace: access to it also requires rights to the keys in it."""
    return isinstance(value, dict) and bool(value)


def standing_at(tree: Tree, key: str) -> tuple[Value, str | None]:
    """Return the value at a canonical key (or None), and the name of a parent that is not a namespace (or None).

    If a key below such a parent is set, `rosmaster` replaces the parent with a namespace.
    """
    node: Value = tree
    passed = ""
    for part in parts_of(key):
        if not isinstance(node, dict):
            return None, passed
        node = node.get(part)
        if node is None:
            return None, None
        passed += f"/{part}"
    return node, None


def names_in(tree: Tree, above: str = "/") -> Iterator[str]:
    """Yield the names of parameters as `rosmaster` lists them, without namespaces.

    `rosmaster` does not prefix a key of a dictionary that begins with `/` or `~`.
    """
    for key, value in tree.items():
        name = key if key.startswith(("/", "~")) else above + key
        if isinstance(value, dict):
            yield from names_in(value, name if name == "~" or name.endswith("/") else f"{name}/")
        else:
            yield name


def same_value(one: Value, other: Value) -> bool:
    """Return whether two values are equal for a node, to which 1, 1.0 and True are not."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same_value(part, other[name]) for name, part in one.items())
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(same_value, one, other))
    return type(one) is type(other) and one == other


def merge(before: Mapping[str, Value], there: Mapping[str, Value], here: Mapping[str, Value]) -> Tree:
    """Return the tree `here` with what changed `there` since `before`, except what has also changed here."""
    result = dict(here)
    for name in {**before, **there}:
        was, new, own = before.get(name), there.get(name), here.get(name)
        if same_value(was, new):
            continue
        if isinstance(new, dict) and isinstance(own, dict):
            result[name] = merge(was if isinstance(was, dict) else {}, new, own)
        elif same_value(was, own):
            result.pop(name, None)
            if name in there:
                result[name] = new
    return result
