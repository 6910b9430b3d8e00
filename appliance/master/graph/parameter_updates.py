"""Compute the updates for subscribers when a parameter is set or deleted, like rosmaster's `compute_param_updates`.

They depend on the canonical key that the policy allowed the caller to change, never on names in a value:

1. Subscribers to the changed key, or to a key above it, get the changed key and its value.
2. Subscribers to a key below it get their part of the new value, or `{}`, unless the value is not a namespace.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from roswire.xmlrpc import Value


class ParameterUpdate(NamedTuple):
    """Subscribers to `subscribed` get this value of `key`."""

    subscribed: str
    key: str
    value: Value


def updates_of(key: str, value: Value, below: Iterable[str]) -> Iterator[ParameterUpdate]:
    """Yield the updates for a new value (`{}` if deleted). `below` are the subscribed keys below `key`."""
    for above in _upwards(key):
        yield ParameterUpdate(above, key, value)
    if isinstance(value, dict):
        for subscribed in below:
            yield ParameterUpdate(
                subscribed, subscribed, _member(value, subscribed[len(key.rstrip("/")) + 1 :])
            )


def settled(value: Value) -> Value:
    """Copy the namespaces of a value, because later calls change them in place."""
    return {name: settled(member) for name, member in value.items()} if isinstance(value, dict) else value


def _upwards(key: str) -> Iterator[str]:
    while key != "/":
        yield key
        key = key.rpartition("/")[0] or "/"
    yield key


def _member(value: Value, path: str) -> Value:
    for part in path.split("/"):
        if not isinstance(value, dict) or part not in value:
            return {}
        value = value[part]
    return value
