"""What a process may do, as its row in the table of roles says; how that is enforced is in `seccomp` and `landlock`."""

import socket
from dataclasses import dataclass

UNIX = (int(socket.AF_UNIX),)
NETWORK = (*UNIX, int(socket.AF_INET), int(socket.AF_INET6))
ROUTES = (*NETWORK, int(socket.AF_NETLINK))  # names are looked up by way of the kernel's routes


@dataclass(frozen=True)
class Walls:
    """What a process may do.

    `listed`: only calls of the kernel that are on a list; else all but those that no process of ours makes. `families`
    are those of sockets that it may make. `programs` are what it may execute, and what they load: none for most.
    `reads` and `writes` are folders and files, `writes` readable, too; of those that are not there nothing is granted.
    `binds` and `reaches` are the TCP ports it may listen on and connect to; None: any. A listed process that has none
    of them may not even ask (`bind`, `connect`), of whatever family.
    """

    listed: bool = False
    families: tuple[int, ...] = UNIX
    programs: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    binds: tuple[int, ...] | None = ()
    reaches: tuple[int, ...] | None = ()
