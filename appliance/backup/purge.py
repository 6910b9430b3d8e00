"""The end of a state directory: all of it is removed; small files (keys, tokens, certificates) are written over first.

What a file system or a disk keeps of a file that was written over (a journal's copies, spare blocks of a flash) nobody
can reach from here: where that matters the disk itself is encrypted, and its key destroyed.
"""

import os
import shutil
import stat
from pathlib import Path

from appliance.backup.contents import BackupError
from appliance.supervisor.errors import StartError
from appliance.supervisor.state_directory import StateDirectory, foreign

_SMALL = 64 << 10
"""Bytes up to which a file is written over."""


def purge(state: Path) -> tuple[int, int]:
    """Remove a state directory that no appliance uses: how many files there were, and how many were written over.

    Raises `BackupError` where there is none, where an appliance uses it, or where something cannot be removed.
    """
    state = state.absolute()
    try:
        reason = foreign(state)
        if not state.is_dir() or reason is not None:
            raise BackupError(reason or f"there is no state directory {state}")
        if not any(state.iterdir()):
            raise BackupError(f"{state} is empty: there is nothing to purge")
        lock = StateDirectory(state)
    except StartError as error:
        raise BackupError(str(error)) from None
    except OSError as error:
        raise BackupError(f"{state}: {error.strerror}") from error
    try:
        counts = _write_over(state)
        # With the lock still held, no appliance begins in the middle.
        for entry in state.iterdir():
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            else:
                entry.unlink()
        os.sync()
    except OSError as error:
        raise BackupError(
            f"{error.filename or state}: {error.strerror}; what is left is still there"
        ) from error
    finally:
        lock.close()
    state.rmdir()
    return counts


def _write_over(state: Path) -> tuple[int, int]:
    """No link is followed, and of a file with another name nothing is written: it is not only ours."""
    files = written = 0
    for _folder, _folders, names, at in os.fwalk(state, follow_symlinks=False):
        for name in names:
            files += 1
            found = os.stat(name, dir_fd=at, follow_symlinks=False)
            if not stat.S_ISREG(found.st_mode) or found.st_nlink != 1 or not 0 < found.st_size <= _SMALL:
                continue
            descriptor = os.open(name, os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=at)
            try:
                os.pwrite(descriptor, os.urandom(found.st_size), 0)
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
            written += 1
    return files, written
