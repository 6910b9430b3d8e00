"""Remove a state directory, and overwrite small files (keys, tokens, certificates) first.

Copies of an overwritten file may remain in a journal, or in spare blocks of flash memory. If that matters, encrypt the
disk and destroy its key.
"""

import os
import shutil
import stat
from pathlib import Path

from appliance.backup.contents import BackupError
from appliance.supervisor.errors import StartError
from appliance.supervisor.state_directory import StateDirectory, foreign

_SMALL = 64 << 10
"""The size in bytes up to which a file is overwritten."""


def purge(state: Path) -> tuple[int, int]:
    """Remove an unused state directory; return the number of files and the number of overwritten files.

    Raises `BackupError` if the directory does not exist or is in use, or if a file cannot be removed.
    """
    state = state.absolute()
    try:
        reason = foreign(state)
        if not state.is_dir() or reason is not None:
            raise BackupError(reason or f"the state directory {state} does not exist")
        if not any(state.iterdir()):
            raise BackupError(f"{state} is empty: nothing to purge")
        lock = StateDirectory(state)
    except StartError as error:
        raise BackupError(str(error)) from None
    except OSError as error:
        raise BackupError(f"{state}: {error.strerror}") from error
    try:
        counts = _write_over(state)
        # The lock is still held, so no appliance can start in between.
        for entry in state.iterdir():
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            else:
                entry.unlink()
        os.sync()
    except OSError as error:
        raise BackupError(
            f"{error.filename or state}: {error.strerror}; the remaining files are unchanged"
        ) from error
    finally:
        lock.close()
    state.rmdir()
    return counts


def _write_over(state: Path) -> tuple[int, int]:
    """Overwrite small files except links; return the numbers of all files and of overwritten files."""
    files = written = 0
    for _folder, _folders, names, at in os.fwalk(state, follow_symlinks=False):
        for name in names:
            files += 1
            written += write_over(name, at)
    return files, written


def write_over(name: str, folder: int) -> bool:
    """Overwrite a small file of an open folder; return False for other files. Raises `OSError`."""
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
