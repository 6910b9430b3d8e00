"""Define the permissions of a sandbox, which `seccomp` and `landlock` enforce."""

import socket
from dataclasses import dataclass

UNIX = (int(socket.AF_UNIX),)
NETWORK = (*UNIX, int(socket.AF_INET), int(socket.AF_INET6))
ROUTES = (*NETWORK, int(socket.AF_NETLINK))  # name lookups read the kernel's routes


@dataclass(frozen=True)
class SandboxPlan:
    """The permissions of a process.

    `allowlist`: permit only listed system calls; otherwise, deny only those that no process of the appliance makes.
    `families`: address families of the sockets that the process may make. `programs`: files that it may execute, and
    the libraries they load. `reads`, `writes`: folders and files; paths in `writes` may also be read. A missing path
    grants nothing. `binds`, `connects`: TCP ports to listen on and to connect to; None: any port. With an allowlist and
    without ports, the system calls `bind` and `connect` fail for every family.
    """

    allowlist: bool = False
    families: tuple[int, ...] = UNIX
    programs: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    binds: tuple[int, ...] | None = ()
    connects: tuple[int, ...] | None = ()
