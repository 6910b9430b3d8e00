"""The files and TCP ports of a process, by Landlock: it needs no privilege, and what a process starts inherits it.

The kernel's version of Landlock (its ABI) says what can be limited: files from 1 (Linux 5.13), TCP ports from 4 (6.7),
signals and abstract sockets outside of the walls from 6 (6.12). What it has not is left open, and told.
"""

import contextlib
import ctypes
import os
import stat
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

from appliance.supervisor.privileges import prctl
from appliance.supervisor.sandbox.sandbox_plan import Walls

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446  # the same on all machines
_ASK_VERSION = 1
_BENEATH, _PORT = 1, 2
_BIND, _CONNECT = 1 << 0, 1 << 1
_SCOPES = 0b11  # abstract Unix sockets, signals
_EXECUTE, _WRITE_FILE, _READ_FILE, _READ_DIR, _TRUNCATE, _IOCTL = (1 << bit for bit in (0, 1, 2, 3, 14, 15))
_OF_FILES = _EXECUTE | _WRITE_FILE | _READ_FILE | _TRUNCATE | _IOCTL
_READ = _READ_FILE | _READ_DIR
_PR_SET_NO_NEW_PRIVS = 38

FILES, PORTS, SIGNALS = 1, 4, 6
"""The first ABI that limits each."""


class LandlockError(Exception):
    """The kernel has Landlock and refuses; the text says what."""


def version() -> int:
    """The ABI of the kernel's Landlock; 0 where there is none, or it is turned off."""
    return max(_call(_CREATE_RULESET, None, 0, _ASK_VERSION)[0], 0)


def lacking(abi: int) -> list[str]:
    """What this version leaves open, in words."""
    if abi < FILES:
        return ["the kernel has no Landlock: files are for the users' rights alone"]
    missing = [(PORTS, "TCP ports"), (SIGNALS, "signals to other processes of its user")]
    return [f"the kernel's Landlock ({abi}) does not limit {what}" for since, what in missing if abi < since]


def raise_wall(walls: Walls) -> int:
    """Limit this process and all it starts to the files and ports of `walls`; the ABI that did it, 0 for none.

    Raises `LandlockError`.
    """
    abi = version()
    if abi == 0:
        return 0
    every = _rights_of_files(abi)
    ports = 0
    if abi >= PORTS:
        ports = (_BIND if walls.binds is not None else 0) | (_CONNECT if walls.reaches is not None else 0)
    ruleset = _ruleset(abi, every, ports)
    try:
        _grant_files(ruleset, walls, every)
        for right, granted in ((_BIND, walls.binds), (_CONNECT, walls.reaches)):
            for port in granted or () if ports & right else ():
                _require(_call(_ADD_RULE, ruleset, _PORT, struct.pack("=QQ", right, port), 0), f"port {port}")
        prctl(_PR_SET_NO_NEW_PRIVS, 1)
        _require(_call(_RESTRICT_SELF, ruleset, 0), "this process")
    finally:
        os.close(ruleset)
    return abi


def _rights_of_files(abi: int) -> int:
    """All rights that this version knows."""
    rights = (1 << 13) - 1
    for since, right in ((2, 1 << 13), (3, _TRUNCATE), (5, _IOCTL)):
        rights |= right if abi >= since else 0
    return rights


def _ruleset(abi: int, files: int, ports: int) -> int:
    attributes = struct.pack("=QQQ", files, ports, _SCOPES)
    size = 24 if abi >= SIGNALS else 16 if abi >= PORTS else 8
    return _require(_call(_CREATE_RULESET, attributes[:size], size, 0), "a ruleset")


def _grant_files(ruleset: int, walls: Walls, every: int) -> None:
    grants = (
        (walls.programs, _EXECUTE | _READ_FILE),
        (walls.reads, _READ),
        (walls.writes, every & ~_EXECUTE),
    )
    for paths, rights in grants:
        for path, descriptor in _opened(paths):
            folder = stat.S_ISDIR(os.fstat(descriptor).st_mode)
            granted = rights if folder else rights & _OF_FILES
            # struct landlock_path_beneath_attr is packed
            rule = struct.pack("=Qi", granted, descriptor)
            _require(_call(_ADD_RULE, ruleset, _BENEATH, rule, 0), path)


def _opened(paths: Iterable[str]) -> Iterator[tuple[str, int]]:
    """Those that are there and may be reached; nothing is to be granted of the others."""
    for path in paths:
        with contextlib.suppress(FileNotFoundError, NotADirectoryError, PermissionError):
            descriptor = os.open(Path(path), os.O_PATH | os.O_CLOEXEC)
            try:
                yield path, descriptor
            finally:
                os.close(descriptor)


def _call(number: int, *arguments: int | bytes | None) -> tuple[int, int]:
    """The result of a call of the kernel, and its error."""
    libc = ctypes.CDLL(None, use_errno=True)
    given = [ctypes.c_long(argument) if isinstance(argument, int) else argument for argument in arguments]
    result: int = libc.syscall(ctypes.c_long(number), *given)
    return result, ctypes.get_errno()


def _require(outcome: tuple[int, int], what: str) -> int:
    result, error = outcome
    if result < 0:
        raise LandlockError(f"Landlock takes no rule for {what}: {os.strerror(error)}")
    return result
