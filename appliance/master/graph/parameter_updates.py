"""Who is told what when a parameter is set or deleted: computed from the key and the value that were decided.

As ROSMaster computes it (rosmaster's `compute_param_updates`), but from canonical keys alone, so that nobody is told of
a key that is not the decided one or below it, whatever the names in a value look like:

1. Who subscribed to the key, or to something above it, is told the key and its value.
2. Who subscribed to something below it is told what that has in the new value, or `{}`: it is not set any more.
   A value that is no namespace tells nothing of what was below it.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from roswire.xmlrpc import Value


class Update(NamedTuple):
    """Those who subscribed to `subscribed` are told that `key` has this value; all keys are canonical."""

    subscribed: str
    key: str
    value: Value


def updates_of(key: str, value: Value, below: Iterable[str]) -> Iterator[Update]:
    """What follows when `key` has this value now, or `{}`: it was deleted. `below` are subscribed keys below it."""
    for above in _upwards(key):
        yield Update(above, key, value)
    if isinstance(value, dict):
        for subscribed in below:
            yield Update(subscribed, subscribed, _member(value, subscribed[len(key.rstrip("/")) + 1 :]))


def settled(value: Value) -> Value:
    """The value as it is now: its namespaces are copied, which later calls change in their place."""
    return {name: settled(member) for name, member in value.items()} if isinstance(value, dict) else value


def _upwards(key: str) -> Iterator[str]:
    while key != "/":
        yield key
        key = key.rpartition("/")[0] or "/"
    yield key


def _member(value: Value, path: str) -> Value:
    """What is at the path in a namespace; `{}` for nothing."""
    for part in path.split("/"):
        if not isinstance(value, dict) or part not in value:
            return {}
        value = value[part]
    return value
