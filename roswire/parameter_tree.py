"""The tree of parameters as ROSMaster has it: what stands at a key, and in the way of one."""

from collections.abc import Iterator
from functools import lru_cache

from roswire.xmlrpc import Value

Tree = dict[str, Value]


@lru_cache(256)
def parts_of(key: str) -> tuple[str, ...]:
    """The segments of a key; whoever sets it asks for them again and again."""
    return tuple([part for part in key.split("/") if part])


def holds_others(value: Value) -> bool:
    """Whether a value is a namespace with something in it: whose rights are asked, too."""
    return isinstance(value, dict) and bool(value)


def standing_at(tree: Tree, key: str) -> tuple[Value, str | None]:
    """What `key` (canonical) has, None for nothing; and its parent that has a value and is no namespace, if any.

    Such a parent is in the way: ROSMaster replaces it by a namespace when something below it is set.
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
    """The names of all values in a tree that stands at `above`, as ROSMaster tells them; a namespace is none.

    A key of a dictionary may begin with `/` or `~`: ROSMaster tells it as it is.
    """
    for key, value in tree.items():
        name = key if key.startswith(("/", "~")) else above + key
        if isinstance(value, dict):
            yield from names_in(value, name if name == "~" or name.endswith("/") else f"{name}/")
        else:
            yield name
