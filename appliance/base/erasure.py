"""Overwrite small files (keys, tokens, certificates) before they are removed.

Copies of an overwritten file may remain in a journal, or in spare blocks of flash memory.
"""

import os
import stat

_SMALL = 64 << 10
"""The largest file that is overwritten, in bytes."""


def write_over(name: str, folder: int) -> bool:
    """Overwrite a small regular file without further hard links; return False for any other. Raises `OSError`."""
    found = os.stat(name, dir_fd=folder, follow_symlinks=False)
    if not stat.S_ISREG(found.st_mode) or found.st_nlink != 1 or not 0 < found.st_size <= _SMALL:
        return False
    descriptor = os.open(name, os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=folder)
    try:
        os.pwrite(descriptor, os.urandom(found.st_size), 0)
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    return True
