"""Load the library for netlink when a network is first changed: it has 200 modules, and most verbs change none."""

from typing import Any


def library() -> Any:
    import pyroute2  # noqa: PLC0415  see the head

    return pyroute2
