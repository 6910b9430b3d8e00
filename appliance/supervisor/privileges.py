"""What a child gives up before it runs a line of its own.

Invariants, in the order in which they are made true by `drop`:

1. The child dies with the supervisor (`PR_SET_PDEATHSIG`), also when that was killed before the request
   was made.
2. No supplementary groups, no capability in any of the five sets, no way to gain one (`no_new_privs`).
3. Files it makes are its own (`umask 077`).

As a caller who is not root only 1 and 3 and `no_new_privs` apply; there is nothing else to give up.
"""

import ctypes
import os
import resource
import signal

from appliance.supervisor.users import Account

_PR_SET_PDEATHSIG = 1
_PR_CAPBSET_DROP = 24
_PR_SET_NO_NEW_PRIVS = 38
_PR_CAP_AMBIENT = 47
_PR_CAP_AMBIENT_CLEAR_ALL = 4
_CLONE_NEWNET = 0x40000000
_LAST_CAPABILITY_FILE = "/proc/sys/kernel/cap_last_cap"
_CAPABILITY_VERSION_3 = 0x20080522


def die_with_parent(parent: int) -> None:
    """Ask the kernel to kill this process when `parent`, which must be the parent, dies.

    To be called after the change of user, which clears the request. Exits at once when the parent is
    gone already.
    """
    prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def raise_file_limit(wanted: int) -> int:
    """Raise the limit on open files to `wanted`, or as far as it may be raised; returns what it is now."""
    _soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard == resource.RLIM_INFINITY or hard >= wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        return wanted
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, wanted))
    except (ValueError, PermissionError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
        return hard
    return wanted


def leave_network() -> None:
    """Move this process into an empty network namespace of its own. Raises `OSError` when refused."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_CLONE_NEWNET) != 0:
        raise _last_error("unshare(CLONE_NEWNET)")


def drop(account: Account, *, parent: int) -> None:
    """Become `account` for good; see the invariants above. Raises `OSError` when the kernel refuses."""
    os.umask(0o077)
    if os.geteuid() == 0:
        _empty_bounding_set()
        os.setgroups([])
        os.setresgid(account.gid, account.gid, account.gid)
        os.setresuid(account.uid, account.uid, account.uid)
        _empty_capabilities()
    prctl(_PR_SET_NO_NEW_PRIVS, 1)
    die_with_parent(parent)


def _empty_bounding_set() -> None:
    # Without CAP_SETPCAP (a container may withhold it) the bounding set stays. With no_new_privs it
    # gives nothing: it only ever limited what an execve may add.
    with open(_LAST_CAPABILITY_FILE) as file:  # noqa: PTH123  pathlib is not loaded in this early stage
        last = int(file.read())
    for capability in range(last + 1):
        try:
            prctl(_PR_CAPBSET_DROP, capability)
        except PermissionError:
            return


def _empty_capabilities() -> None:
    prctl(_PR_CAP_AMBIENT, _PR_CAP_AMBIENT_CLEAR_ALL)
    libc = ctypes.CDLL(None, use_errno=True)
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION_3, 0)
    nothing = (ctypes.c_uint32 * 6)()
    if libc.capset(header, nothing) != 0:
        raise _last_error("capset")


def prctl(option: int, first: int, second: int = 0) -> None:
    """`prctl(2)`. Raises `OSError`."""
    libc = ctypes.CDLL(None, use_errno=True)
    zero = ctypes.c_ulong(0)
    if libc.prctl(ctypes.c_int(option), ctypes.c_ulong(first), ctypes.c_ulong(second), zero, zero) != 0:
        raise _last_error(f"prctl({option})")


def _last_error(call: str) -> OSError:
    number = ctypes.get_errno()
    return OSError(number, f"{call}: {os.strerror(number)}")
