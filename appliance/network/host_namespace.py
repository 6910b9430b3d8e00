"""Whether the network namespace we live in is the machine's own instead of a container's.

With `isolation: container` the firewall is put where the appliance was started. In a container that shares the
machine's network (`--network host`, `hostNetwork: true`) that is the machine: its rules would hit everybody there.
"""

from pathlib import Path

# The kernel has this setting in the namespace that the machine started with, and in no other.
_ONLY_THERE = Path("sys/net/core/netdev_max_backlog")
# What Docker and Podman put into every container.
_MARKS = (".dockerenv", "run/.containerenv")
_INITIAL_PIDS = "pid:[4026531836]"  # the kernel's fixed name (PROC_PID_INIT_INO) of the machine's process ids


def lives_on_the_machines_network(proc: Path = Path("/proc")) -> bool:
    """Whether this namespace is the one that the machine started with."""
    return (proc / _ONLY_THERE).exists()


def is_contained(root: Path = Path("/")) -> bool:
    """Whether this process lives in a container, with or without a network of its own."""
    if any((root / mark).exists() for mark in _MARKS):
        return True
    try:
        return str((root / "proc/self/ns/pid").readlink()) != _INITIAL_PIDS
    except OSError:
        return False


def bridges(classes: Path = Path("/sys/class/net")) -> list[str]:
    """The bridges of this namespace: a container has none, the machine that runs containers has one."""
    return sorted(link.name for link in classes.glob("*") if (link / "bridge").is_dir())
