"""Query the kernel whether a time service keeps the clock synchronised (adjtimex(2)).

Only the supervisor can: all sandboxes deny this system call.
"""

import ctypes

_STA_UNSYNC = 0x0040
_LARGE_ENOUGH = 512  # bytes; the kernel writes 208


class Timex(ctypes.Structure):
    """The beginning of `struct timex`; with `modes` 0 the kernel only reads."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * _LARGE_ENOUGH),
    )


_libc = ctypes.CDLL(None)


def clock_is_synchronised() -> bool | None:
    """Return whether the clock is synchronised; None if the kernel denies the call, as in some containers."""
    timex = Timex()
    if _libc.adjtimex(ctypes.pointer(timex)) < 0:
        return None
    return not timex.status & _STA_UNSYNC
