"""Define the permissions of a sandbox, which `seccomp` and `landlock` enforce."""

import socket
from dataclasses import dataclass

UNIX = (int(socket.AF_UNIX),)
NETWORK = (*UNIX, int(socket.AF_INET), int(socket.AF_INET6))
ROUTES = (*NETWORK, int(socket.AF_NETLINK))  # name lookups read the kernel's routes


@dataclass(frozen=True)
class SandboxPlan:
    """The permissions of a process.

    Without `allowlist`, only calls that no process of the appliance makes are denied. Paths in `writes` may also
    be read, and a missing path grants nothing. `binds`, `connects`: None permits any TCP port; with an allowlist
    and without ports, the calls fail for every family.
    """

    allowlist: bool = False
    families: tuple[int, ...] = UNIX
    programs: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    binds: tuple[int, ...] | None = ()
    connects: tuple[int, ...] | None = ()
