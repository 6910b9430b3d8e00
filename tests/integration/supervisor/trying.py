import ctypes
import errno
import json
import mmap
import os
import resource
import signal
import socket
import struct
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from appliance.supervisor.sandbox.seccomp import FORBIDDEN, LIBRARY

FAMILIES = ("AF_UNIX", "AF_INET", "AF_INET6", "AF_NETLINK", "AF_PACKET", "AF_ALG", "AF_VSOCK", "AF_BLUETOOTH")
_KINDS = {"AF_NETLINK": socket.SOCK_RAW, "AF_PACKET": socket.SOCK_RAW, "AF_ALG": socket.SOCK_SEQPACKET}
NEW_USER = 0x10000000
DIVIDES = bytes.fromhex(  # a module with a memory, and a function `divide` of two 32-bit integers
    "0061736d01000000010701 60027f7f017f 03020100 0503010001"
    "0713 02 06 6d656d6f7279 0200 06 646976696465 0000 0a0901 0700200020016d0b"
)
_PTRACE_ATTACH = 16
_ENDS_THE_TRIAL = {"reboot", "vhangup"}  # without the sandbox these calls would have an effect


def main(*_given: Any) -> None:
    told = sys.stderr  # the launcher has redirected standard output there
    told.write(json.dumps(tried(json.loads(Path("trial").read_text()))) + "\n")
    told.flush()


def run_modules(*_given: Any) -> None:
    from rosmop.fast.wasm_instance import WasmInstance, WasmTrap, translate  # noqa: PLC0415  within the sandbox, as a relay loads it

    told: dict[str, Any] = {"before": len(_executable()), "results": [], "traps": []}
    machines = []
    for _ in range(2):
        instance = WasmInstance(translate(DIVIDES, 1 << 24), 1 << 24)
        machines.append(instance)
        instance.reserve(1 << 24)
        instance.memory[-1] = 1
        told["results"].append(instance.call("divide", 42, 6, fuel=100))
        try:
            instance.call("divide", 1, 0, fuel=100)
        except WasmTrap as trap:
            told["traps"].append(trap.reason)
    told["executable"] = _executable()
    told["threads"] = len(list(Path("/proc/self/task").iterdir()))
    sys.stderr.write(json.dumps(told) + "\n")
    sys.stderr.flush()


def _executable() -> list[str]:
    lines = [line.split(maxsplit=5) for line in Path("/proc/self/maps").read_text().splitlines()]
    return [parts[1] for parts in lines if "x" in parts[1] and (len(parts) < 6 or "w" in parts[1])]


def tried(wanted: dict[str, Any]) -> dict[str, Any]:
    return {
        "calls": {name: _forbidden(name) for name in FORBIDDEN if name not in _ENDS_THE_TRIAL},
        "new namespace": _new_namespace(),
        "fork": _outcome(_fork),
        "program": _outcome(lambda: _run("/bin/true")),
        "write and execute": _outcome(lambda: mmap.mmap(-1, 4096, prot=7).close()),
        "execute later": _outcome(_execute_later),
        "families": [name for name in FAMILIES if _outcome(partial(_make_and_close, name)) == "done"],
        "bind": _outcome(lambda: _socket("AF_INET").bind(("127.0.0.1", 0))),
        "connect": [_outcome(partial(_connect, port)) for port in wanted["ports"]],
        "read": {path: _outcome(Path(path).read_bytes) for path in wanted["reads"]},
        "write": {path: _outcome(partial(Path(path).write_text, "x")) for path in wanted["writes"]},
        "other process": _other_process(wanted["pid"]),
        "filtered": "Seccomp:\t2" in Path("/proc/self/status").read_text(),
    }


def _outcome(attempt: Callable[[], Any]) -> str:
    try:
        attempt()
    except OSError as error:
        return errno.errorcode.get(error.errno or 0, str(error))
    return "done"


def _socket(family: str) -> socket.socket:
    return socket.socket(getattr(socket, family), _KINDS.get(family, socket.SOCK_STREAM))


def _make_and_close(family: str) -> None:
    _socket(family).close()


def _connect(port: int) -> None:
    with _socket("AF_INET") as sock:
        sock.connect(("127.0.0.1", port))


def _forbidden(name: str) -> str:
    # 0 is PTRACE_TRACEME: the process would then stop at its next signal
    return _call(name, _PTRACE_ATTACH if name == "ptrace" else 0)


def _call(name: str, *given: int) -> str:
    number = ctypes.CDLL(LIBRARY).seccomp_syscall_resolve_name(name.encode())
    if number < 0:
        return "not there"
    libc = ctypes.CDLL(None, use_errno=True)
    arguments = (number, *given, *[0] * (6 - len(given)))
    result = libc.syscall(*(ctypes.c_long(argument) for argument in arguments))
    return "done" if result >= 0 else errno.errorcode[ctypes.get_errno()]


def _other_process(pid: int) -> dict[str, str]:
    """Try every call that may change another process of the user; the last signal ends it."""
    queued = ctypes.create_string_buffer(struct.pack("iii", 0, 0, -1), 128)  # a siginfo_t with SI_QUEUE
    none, all_cores = ctypes.create_string_buffer(16), ctypes.create_string_buffer(b"\xff" * 128, 128)
    queue, no_limit, cores = map(ctypes.addressof, (queued, none, all_cores))
    idle, core_files = 19, resource.RLIMIT_CORE
    other = os.pidfd_open(pid)
    return {
        "setpriority": _call("setpriority", os.PRIO_PROCESS, pid, idle),
        "sched_setaffinity": _call("sched_setaffinity", pid, 128, cores),
        "prlimit64": _call("prlimit64", pid, core_files, no_limit),
        "pidfd_send_signal": _call("pidfd_send_signal", other),
        "tkill": _call("tkill", pid),
        "tgkill": _call("tgkill", pid, pid),
        "rt_sigqueueinfo": _call("rt_sigqueueinfo", pid, 0, queue),
        "rt_tgsigqueueinfo": _call("rt_tgsigqueueinfo", pid, pid, 0, queue),
        "kill": _call("kill", pid, signal.SIGUSR1),
    }


def _new_namespace() -> str:
    number = ctypes.CDLL(LIBRARY).seccomp_syscall_resolve_name(b"clone")
    libc = ctypes.CDLL(None, use_errno=True)
    arguments = (NEW_USER | signal.SIGCHLD, 0, 0, 0, 0)
    result = libc.syscall(ctypes.c_long(number), *(ctypes.c_long(argument) for argument in arguments))
    if result == 0:
        os._exit(0)
    if result < 0:
        return errno.errorcode[ctypes.get_errno()]
    os.waitpid(result, 0)
    return "done"


def _fork() -> None:
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitpid(child, 0)


def _run(program: str) -> None:
    os.waitpid(os.posix_spawn(program, [program], {}), 0)


def _execute_later() -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    libc.mmap.restype = ctypes.c_void_p
    private_anonymous = 0x22
    at = libc.mmap(None, ctypes.c_size_t(4096), 3, private_anonymous, -1, 0)
    if libc.mprotect(ctypes.c_void_p(at), ctypes.c_size_t(4096), 5) != 0:
        raise OSError(ctypes.get_errno(), "mprotect")


if __name__ == "__main__":
    sys.stdout.write(json.dumps(tried(json.loads(Path("trial").read_text()))) + "\n")
