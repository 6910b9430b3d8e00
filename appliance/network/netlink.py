"""Load the library for netlink when a network is first changed: it has 200 modules, and most verbs change none."""

from types import ModuleType


def loaded() -> ModuleType:
    import pyroute2  # noqa: PLC0415  see the head

    module: ModuleType = pyroute2
    return module
