"""The filter of a process's calls of the kernel, made with libseccomp (which knows their numbers on every machine).

A call that is refused fails with EPERM; one that is not on the list, or that would hide its arguments from the filter
(`clone3`), fails with ENOSYS: libraries then do without. No process is killed for a call. A library may try anything on
a kernel of tomorrow, and a relay that is killed takes its topics away; whoever took a process over gains nothing by
trying. Calls of another machine's numbering (32 bits) end the process: none of our programs makes any.

Memory is never writable and executable at once; a page that was written may be made executable later (`mprotect`), as
compiled code needs it.
"""

import ctypes
import errno
import os
from collections.abc import Iterable

from appliance.supervisor.sandbox.sandbox_plan import Walls
from appliance.supervisor.sandbox.system_calls import FORBIDDEN, LISTED, STARTS_PROGRAMS

LIBRARY = "libseccomp.so.2"
_ALLOW, _ERROR, _KILL_PROCESS = 0x7FFF0000, 0x00050000, 0x80000000
_NOT_EQUAL, _EQUAL, _AT_LEAST, _MASKED_EQUAL = 1, 4, 5, 7
_OF_ANOTHER_MACHINE, _SPECULATION_STAYS, _AS_A_TREE = 2, 7, 8  # attributes of a filter
_REFUSED, _UNKNOWN = _ERROR | errno.EPERM, _ERROR | errno.ENOSYS
_FAMILIES = 64  # more than there are
_NAMESPACES = tuple(1 << bit for bit in (17, 25, 26, 27, 28, 29, 30))  # CLONE_NEW…
_THREAD = 0x00010000  # CLONE_THREAD
_WRITE_AND_EXECUTE = 2 | 4
_MAPPING = ("mmap", "mprotect", "pkey_mprotect")  # each with the protection as its third argument
_WHICH_PERSONALITY = 0xFFFFFFFF

Comparison = tuple[int, int, int, int]  # argument, operator, value, second value


class SeccompError(Exception):
    """There is no filter; the text says why."""


class _Comparison(ctypes.Structure):
    _fields_ = (
        ("argument", ctypes.c_uint),
        ("operator", ctypes.c_int),
        ("first", ctypes.c_uint64),
        ("second", ctypes.c_uint64),
    )


class _Filter:
    """A filter in the making."""

    def __init__(self, otherwise: int) -> None:
        try:
            self._library = ctypes.CDLL(LIBRARY, use_errno=True)
        except OSError as error:
            raise SeccompError(f"{LIBRARY} is not there: apt install libseccomp2 ({error})") from error
        self._library.seccomp_init.restype = ctypes.c_void_p
        context = self._library.seccomp_init(ctypes.c_uint32(otherwise))
        if not context:
            raise SeccompError("libseccomp makes no filter on this machine")
        self._context = ctypes.c_void_p(context)
        self._otherwise = otherwise

    def set(self, attribute: int, value: int) -> None:
        """Set an attribute; one that this libseccomp or kernel does not know makes no difference to what is refused."""
        self._library.seccomp_attr_set(self._context, ctypes.c_int(attribute), ctypes.c_uint32(value))

    def add(self, action: int, names: Iterable[str], *comparisons: Comparison) -> None:
        """Take `action` for these calls, when all comparisons hold; what this machine does not have is left out."""
        if action == self._otherwise:
            return
        compared = (_Comparison * len(comparisons))(*(_Comparison(*comparison) for comparison in comparisons))
        for name in names:
            number = self._library.seccomp_syscall_resolve_name(name.encode())
            if number < 0:
                continue
            result = self._library.seccomp_rule_add_array(
                self._context, ctypes.c_uint32(action), number, len(comparisons), compared
            )
            if result != 0:
                raise SeccompError(f"no rule for {name}: {os.strerror(-result)}")

    def load(self) -> None:
        """Put it in force for this process and all it starts."""
        result = self._library.seccomp_load(self._context)
        self._library.seccomp_release(self._context)
        if result != 0:
            raise SeccompError(f"the kernel takes no filter: {os.strerror(-result)}")


def raise_wall(walls: Walls) -> None:
    """Put the filter in force for this process and all it starts; needs `no_new_privs`. Raises `SeccompError`."""
    made = _Filter(_UNKNOWN if walls.listed else _ALLOW)
    made.set(_OF_ANOTHER_MACHINE, _KILL_PROCESS)
    made.set(_SPECULATION_STAYS, 1)
    made.set(_AS_A_TREE, 2)
    made.add(_REFUSED, FORBIDDEN)
    made.add(_UNKNOWN, ("clone3",))
    if not walls.programs:
        made.add(_REFUSED, STARTS_PROGRAMS)
    _sockets(made, walls)
    _memory(made, walls)
    if walls.listed:
        made.add(_ALLOW, LISTED)
        threads = _THREAD | sum(_NAMESPACES)
        made.add(_ALLOW, ("clone",), (0, _MASKED_EQUAL, threads, _THREAD))
        made.add(_ALLOW, ("bind",) if walls.binds != () else ())
        made.add(_ALLOW, ("connect",) if walls.reaches != () else ())
    else:
        for namespace in _NAMESPACES:
            made.add(_REFUSED, ("clone",), (0, _MASKED_EQUAL, namespace, namespace))
        made.add(_REFUSED, ("personality",), (0, _NOT_EQUAL, _WHICH_PERSONALITY, 0))
    made.load()


def _sockets(made: _Filter, walls: Walls) -> None:
    for family in walls.families if walls.listed else ():
        made.add(_ALLOW, ("socket",), (0, _EQUAL, family, 0))
    if not walls.listed:
        for family in set(range(_FAMILIES)) - set(walls.families):
            made.add(_REFUSED, ("socket",), (0, _EQUAL, family, 0))
        made.add(_REFUSED, ("socket",), (0, _AT_LEAST, _FAMILIES, 0))


def _memory(made: _Filter, walls: Walls) -> None:
    both = _WRITE_AND_EXECUTE
    if not walls.listed:
        made.add(_REFUSED, _MAPPING, (2, _MASKED_EQUAL, both, both))
    for allowed in (0, 2, 4) if walls.listed else ():
        made.add(_ALLOW, _MAPPING, (2, _MASKED_EQUAL, both, allowed))
