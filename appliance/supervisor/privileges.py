"""Drop privileges of a child before its own code runs.

1. The child dies with the supervisor (`PR_SET_PDEATHSIG`), even if the supervisor died before the call.
2. The child has only the role's capabilities, which its own children inherit, and cannot gain others
   (`no_new_privs`).
3. Only the child's user can read the files that the child makes (`umask 077`).

Without root, only 1, 3 and `no_new_privs` apply.
"""

import contextlib
import ctypes
import os
import resource
import signal
from collections.abc import Sequence
from pathlib import Path

from appliance.supervisor.users import Account

_PR_SET_PDEATHSIG = 1
_PR_CAPBSET_DROP = 24
_PR_SET_NO_NEW_PRIVS = 38
_PR_CAP_AMBIENT = 47
_PR_CAP_AMBIENT_RAISE = 2
_PR_CAP_AMBIENT_CLEAR_ALL = 4
_PR_SET_KEEPCAPS = 8
_CLONE_NEWNET = 0x40000000
_LAST_CAPABILITY_FILE = "/proc/sys/kernel/cap_last_cap"
_AUTOGROUP = Path("/proc/self/autogroup")
_CAPABILITY_VERSION_3 = 0x20080522
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}


def die_with_parent(parent: int) -> None:
    """Let the kernel kill this process if its parent dies. A change of user clears this, so call it afterwards."""
    prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def raise_file_limit(wanted: int) -> int:
    """Raise the limit as close to `wanted` as permitted."""
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


def raise_oom_score(score: int) -> None:
    """Let the kernel kill this process earlier if memory is short.

    Call this before the change of user: the role's user may not write the file.
    """
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "r+") as file:  # noqa: PTH123  as below
        if score > int(file.read()):
            file.write(str(score))


def raise_priority(by: int) -> int:
    try:
        os.setpriority(os.PRIO_PROCESS, 0, os.getpriority(os.PRIO_PROCESS, 0) - by)
    except PermissionError:
        return 0
    return by


def add_niceness(by: int) -> bool:
    """Lower the priority of this process, which must be alone in its session; return whether it was permitted.

    With autogroups, niceness orders only the processes of a session, so a session with a process of higher priority
    also gets that priority. A session of lower priority keeps its share, or a busy machine would lock operators out.
    """
    permitted = True
    try:
        os.nice(by)
    except PermissionError:
        permitted = False
    niceness = os.getpriority(os.PRIO_PROCESS, 0)
    if niceness < 0:
        with contextlib.suppress(OSError):
            _AUTOGROUP.write_text(str(niceness), encoding="ascii")
    return permitted


def set_niceness(pid: int, nice: int) -> None:
    """Set the niceness of all threads of a process, and of its session's autogroup. Raises `OSError`."""
    for thread in os.listdir(f"/proc/{pid}/task"):  # noqa: PTH208  pathlib is not loaded in this early stage
        with contextlib.suppress(ProcessLookupError):
            os.setpriority(os.PRIO_PROCESS, int(thread), nice)
    with contextlib.suppress(OSError), open(f"/proc/{pid}/autogroup", "w", encoding="ascii") as file:  # noqa: PTH123  as above
        file.write(str(min(0, nice)))


def shorten_slice(nanoseconds: int) -> None:
    """Let this process run soon after it wakes; its share stays the same. Linux before 6.12 ignores the request."""
    call = _SCHED_SETATTR.get(os.uname().machine)
    if call is None:
        return
    attributes = (ctypes.c_uint32 * 12)()  # struct sched_attr; the slice is a 64-bit number at byte 24
    ctypes.c_int32.from_buffer(attributes, 16).value = os.getpriority(os.PRIO_PROCESS, 0)
    attributes[0] = ctypes.sizeof(attributes)
    ctypes.c_uint64.from_buffer(attributes, 24).value = nanoseconds
    with contextlib.suppress(OSError):
        libc_call("syscall(sched_setattr)", call, 0, attributes, 0)


def leave_network() -> None:
    """Enter a new network namespace. Raises `OSError`."""
    libc_call("unshare(CLONE_NEWNET)", _CLONE_NEWNET)


# The supervisor needs each capability for the use in its comment, and drops all others before it starts any process.
SUPERVISOR_CAPABILITIES = {
    "CHOWN": 0,  # give each role its part of the state directory
    "DAC_OVERRIDE": 1,  # read the roles' parts
    "FOWNER": 3,
    "KILL": 5,  # end the children
    "SETGID": 6,  # start the children as their users (with SETUID)
    "SETUID": 7,
    "SETPCAP": 8,  # start the children without capabilities
    "NET_BIND_SERVICE": 10,  # passed on to charon, for ports 500 and 4500
    "NET_ADMIN": 12,  # firewall
    "NET_RAW": 13,  # the firewall's iptables back end
    "SYS_PTRACE": 19,  # find the process that uses a port, and processes that a crash left in the namespace
    "SYS_ADMIN": 21,  # make and enter namespaces
    "SYS_NICE": 23,  # no load delays a stop, nor the lease of one of two appliances
    "SYS_RESOURCE": 24,  # raise the limit on open files
}


def drop_unused_capabilities() -> None:
    if os.geteuid() != 0:
        return
    kept = sum(1 << number for number in SUPERVISOR_CAPABILITIES.values())
    _empty_bounding_set(but=kept)
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION_3, 0)
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable; again for capabilities from 32
    libc_call("capget", header, sets)
    for index, word in ((0, kept), (1, kept), (2, 0), (3, kept >> 32), (4, kept >> 32), (5, 0)):
        sets[index] &= word & 0xFFFFFFFF
    libc_call("capset", header, sets)


def drop_privileges(account: Account, *, parent: int, capabilities: Sequence[str] = ()) -> None:
    """Become `account` permanently; `capabilities` are of `SUPERVISOR_CAPABILITIES`. Raises `OSError`."""
    os.umask(0o077)
    if os.geteuid() == 0:
        kept = sum(1 << SUPERVISOR_CAPABILITIES[name] for name in capabilities)
        _empty_bounding_set(but=kept)
        os.setgroups([])
        os.setresgid(account.gid, account.gid, account.gid)
        if kept:
            prctl(_PR_SET_KEEPCAPS, 1)
        os.setresuid(account.uid, account.uid, account.uid)
        _reduce_capabilities(kept)
    prctl(_PR_SET_NO_NEW_PRIVS, 1)
    die_with_parent(parent)


def _empty_bounding_set(*, but: int = 0) -> None:
    # Without CAP_SETPCAP (in some containers) the bounding set stays. It limits only the capabilities that an execve
    # may add, and with no_new_privs an execve adds none.
    with open(_LAST_CAPABILITY_FILE) as file:  # noqa: PTH123  pathlib is not loaded in this early stage
        last = int(file.read())
    for capability in range(last + 1):
        if but >> capability & 1:
            continue
        try:
            prctl(_PR_CAPBSET_DROP, capability)
        except PermissionError:
            return


def _reduce_capabilities(kept: int) -> None:
    prctl(_PR_CAP_AMBIENT, _PR_CAP_AMBIENT_CLEAR_ALL)
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION_3, 0)
    low, high = kept & 0xFFFFFFFF, kept >> 32
    libc_call("capset", header, (ctypes.c_uint32 * 6)(low, low, low, high, high, high))
    for capability in SUPERVISOR_CAPABILITIES.values():
        if kept >> capability & 1:
            prctl(_PR_CAP_AMBIENT, _PR_CAP_AMBIENT_RAISE, capability)


def prctl(option: int, first: int, second: int = 0) -> None:
    """Call prctl(2). Raises `OSError`."""
    libc_call(f"prctl({option})", ctypes.c_int(option), *map(ctypes.c_ulong, (first, second, 0, 0)))


def libc_call(what: str, *arguments: object) -> None:
    function = ctypes.CDLL(None, use_errno=True)[what.partition("(")[0]]
    if function(*arguments) != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{what}: {os.strerror(number)}")
