"""Make system calls for which Debian 12's C library has no function; their numbers are the same everywhere."""

import ctypes


def system_call(number: int, *arguments: int | bytes | None) -> tuple[int, int]:
    libc = ctypes.CDLL(None, use_errno=True)
    given = [ctypes.c_long(argument) if isinstance(argument, int) else argument for argument in arguments]
    result: int = libc.syscall(ctypes.c_long(number), *given)
    return result, ctypes.get_errno()
