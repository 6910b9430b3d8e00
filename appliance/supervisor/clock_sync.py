"""Whether a time service keeps the machine's clock, as the kernel says it (adjtimex(2); nothing is set).

The supervisor asks: the walls around the other processes forbid the call.
"""

import ctypes

_STA_UNSYNC = 0x0040
_LARGE_ENOUGH = 512  # bytes; the kernel writes 208


class Timex(ctypes.Structure):
    """The beginning of the kernel's `struct timex`; modes 0 reads."""

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
    """Whether it is; None: this machine's kernel does not tell us, which some containers forbid it."""
    timex = Timex()
    if _libc.adjtimex(ctypes.pointer(timex)) < 0:
        return None
    return not timex.status & _STA_UNSYNC
