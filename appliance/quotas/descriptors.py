"""Limit the connections of a process by its file descriptors."""

import resource


def connections_within(wanted: int) -> int:
    """Return at most half the number of descriptors that this process may open."""
    allowed, _hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    return wanted if allowed == resource.RLIM_INFINITY else max(1, min(wanted, allowed // 2))
