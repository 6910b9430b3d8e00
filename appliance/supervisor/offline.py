"""A process without network: it can make no socket but a Unix one.

Two walls, because neither is there everywhere. A seccomp filter, which needs no privilege and holds in
any container: `socket` for any family but AF_UNIX is refused, and so is io_uring, which could make
sockets past it. And, where the kernel lets us, an empty network namespace, so that nothing would be
there to reach. The filter must hold, the namespace may be refused.
"""

import contextlib
import ctypes
import errno
import os
import platform
import struct

from appliance.supervisor.privileges import leave_network, prctl

_PR_SET_SECCOMP = 22
_SECCOMP_MODE_FILTER = 2
_LOAD_WORD, _JUMP_EQUAL, _JUMP_GREATER_EQUAL, _RETURN = 0x20, 0x15, 0x35, 0x06
_ALLOW, _KILL_PROCESS, _ERROR = 0x7FFF0000, 0x80000000, 0x00050000
_NUMBER, _ARCHITECTURE, _FIRST_ARGUMENT = 0, 4, 16  # offsets in struct seccomp_data (low word: little endian)
_IO_URING_SETUP = 425
_X32_CALLS = 0x40000000  # the second, 32-bit numbering of x86_64
_MACHINES = {
    "x86_64": (0xC000003E, 41),
    "aarch64": (0xC00000B7, 198),
}  # audit architecture, number of `socket`


def leave_network_if_allowed() -> None:
    """The second wall; to be called while still root."""
    if os.geteuid() == 0:
        with contextlib.suppress(PermissionError):
            leave_network()


def forbid_sockets() -> None:
    """The first wall, for this process and all it starts; needs `no_new_privs`. Raises `OSError`."""
    machine = platform.machine()
    if machine not in _MACHINES:
        raise OSError(errno.ENOTSUP, f"a process without network is not possible on {machine} yet")
    program = _filter(*_MACHINES[machine])
    code = ctypes.create_string_buffer(program, len(program))
    # struct sock_fprog: number of instructions, padding, pointer to them
    header = ctypes.create_string_buffer(struct.pack("HxxxxxxP", len(program) // 8, ctypes.addressof(code)))
    prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, ctypes.addressof(header))


def _filter(architecture: int, socket_call: int) -> bytes:
    refuse = _ERROR | errno.EACCES
    rows = [  # operation, jump when true, jump when false, operand
        (_LOAD_WORD, 0, 0, _ARCHITECTURE),
        (_JUMP_EQUAL, 1, 0, architecture),
        (_RETURN, 0, 0, _KILL_PROCESS),
        (_LOAD_WORD, 0, 0, _NUMBER),
        (_JUMP_GREATER_EQUAL, 5, 0, _X32_CALLS),
        (_JUMP_EQUAL, 4, 0, _IO_URING_SETUP),
        (_JUMP_EQUAL, 0, 2, socket_call),
        (_LOAD_WORD, 0, 0, _FIRST_ARGUMENT),
        (_JUMP_EQUAL, 0, 1, 1),  # AF_UNIX
        (_RETURN, 0, 0, _ALLOW),
        (_RETURN, 0, 0, refuse),
    ]
    return b"".join(struct.pack("HBBI", *row) for row in rows)
