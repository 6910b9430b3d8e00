"""Descriptors: what all shares together need of them, and how many connections a process may have with those it has."""

import resource


def connections_within(wanted: int) -> int:
    """So many connections, and no more than half of what this process may open; the rest is for all else it does."""
    allowed, _hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    return wanted if allowed == resource.RLIM_INFINITY else max(1, min(wanted, allowed // 2))
