"""Which texts are resolved ROS names: what RVMaster decides on, and what a key of the policy may be."""

import re

_RESOLVED = re.compile(r"(?:/[A-Za-z0-9_]+)+", re.ASCII)


def is_resolved_name(text: str) -> bool:
    """Whether `text` is a global name in its one canonical spelling: `/a/b`, no doubled or last slash."""
    return _RESOLVED.fullmatch(text) is not None
