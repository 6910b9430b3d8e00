"""Limit files and TCP ports of a process with Landlock, which needs no privilege and which children inherit.

Limits that the kernel lacks are reported: files need Linux 5.13, TCP ports 6.7, signals and abstract sockets 6.12.
"""

import contextlib
import ctypes
import os
import stat
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

from appliance.supervisor.privileges import prctl
from appliance.supervisor.sandbox.sandbox_plan import SandboxPlan

# Make system calls for which Debian 12's C library has no function; their numbers are the same everywhere.


def system_call(number: int, *arguments: int | bytes | None) -> tuple[int, int]:
    libc = ctypes.CDLL(None, use_errno=True)
    given = [ctypes.c_long(argument) if isinstance(argument, int) else argument for argument in arguments]
    result: int = libc.syscall(ctypes.c_long(number), *given)
    return result, ctypes.get_errno()


_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446  # system calls; the same on all architectures
_ASK_VERSION = 1
_BENEATH, _PORT = 1, 2
_BIND, _CONNECT = 1 << 0, 1 << 1
_SCOPES = 0b11  # abstract Unix sockets, signals
_EXECUTE, _WRITE_FILE, _READ_FILE, _READ_DIR, _TRUNCATE, _IOCTL = (1 << bit for bit in (0, 1, 2, 3, 14, 15))
_OF_FILES = _EXECUTE | _WRITE_FILE | _READ_FILE | _TRUNCATE | _IOCTL
_READ = _READ_FILE | _READ_DIR
_PR_SET_NO_NEW_PRIVS = 38

FILES, PORTS, SIGNALS = 1, 4, 6
"""The ABI versions of Landlock that limit files, ports and signals."""


class LandlockError(Exception):
    """The kernel's Landlock rejects a rule."""


def version() -> int:
    return max(system_call(_CREATE_RULESET, None, 0, _ASK_VERSION)[0], 0)


def lacking(abi: int) -> list[str]:
    if abi < FILES:
        return ["the kernel has no Landlock: only file permissions protect files"]
    missing = [(PORTS, "TCP ports"), (SIGNALS, "signals to other processes of its user")]
    return [f"the kernel's Landlock ({abi}) does not limit {what}" for since, what in missing if abi < since]


def restrict(sandbox: SandboxPlan) -> int:
    """Limit this process; return the ABI of Landlock, 0 for none. Raises `LandlockError`."""
    abi = version()
    if abi == 0:
        return 0
    every = _rights_of_files(abi)
    ports = 0
    if abi >= PORTS:
        ports = (_BIND if sandbox.binds is not None else 0) | (
            _CONNECT if sandbox.connects is not None else 0
        )
    ruleset = _ruleset(abi, every, ports)
    try:
        _grant_files(ruleset, sandbox, every)
        for right, granted in ((_BIND, sandbox.binds), (_CONNECT, sandbox.connects)):
            for port in granted or () if ports & right else ():
                _require(
                    system_call(_ADD_RULE, ruleset, _PORT, struct.pack("=QQ", right, port), 0), f"port {port}"
                )
        prctl(_PR_SET_NO_NEW_PRIVS, 1)
        _require(system_call(_RESTRICT_SELF, ruleset, 0), "this process")
    finally:
        os.close(ruleset)
    return abi


def _rights_of_files(abi: int) -> int:
    rights = (1 << 13) - 1
    for since, right in ((2, 1 << 13), (3, _TRUNCATE), (5, _IOCTL)):
        rights |= right if abi >= since else 0
    return rights


def _ruleset(abi: int, files: int, ports: int) -> int:
    attributes = struct.pack("=QQQ", files, ports, _SCOPES)
    size = 24 if abi >= SIGNALS else 16 if abi >= PORTS else 8
    return _require(system_call(_CREATE_RULESET, attributes[:size], size, 0), "a ruleset")


def _grant_files(ruleset: int, sandbox: SandboxPlan, every: int) -> None:
    grants = (
        (sandbox.programs, _EXECUTE | _READ_FILE),
        (sandbox.reads, _READ),
        (sandbox.writes, every & ~_EXECUTE),
    )
    for paths, rights in grants:
        for path, descriptor in _open(paths):
            folder = stat.S_ISDIR(os.fstat(descriptor).st_mode)
            granted = rights if folder else rights & _OF_FILES
            # struct landlock_path_beneath_attr is packed
            rule = struct.pack("=Qi", granted, descriptor)
            _require(system_call(_ADD_RULE, ruleset, _BENEATH, rule, 0), path)


def _open(paths: Iterable[str]) -> Iterator[tuple[str, int]]:
    for path in paths:
        with contextlib.suppress(FileNotFoundError, NotADirectoryError, PermissionError):
            descriptor = os.open(Path(path), os.O_PATH | os.O_CLOEXEC)
            try:
                yield path, descriptor
            finally:
                os.close(descriptor)


def _require(outcome: tuple[int, int], what: str) -> int:
    result, error = outcome
    if result < 0:
        raise LandlockError(f"Landlock rejects the rule for {what}: {os.strerror(error)}")
    return result
