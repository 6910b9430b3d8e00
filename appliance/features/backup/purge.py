"""Remove a state directory, and overwrite small files (keys, tokens, certificates) first.

Copies of an overwritten file may remain in a journal, or in spare blocks of flash memory. If that matters, encrypt the
disk and destroy its key.
"""

import errno
import os
import shutil
from pathlib import Path

from appliance.backup.contents import BackupError
from appliance.base.erasure import write_over
from appliance.base.user_errors import with_remedy
from appliance.features.table import members
from appliance.supervisor.errors import StartError
from appliance.supervisor.state_directory import StateDirectory, foreign


def require_state_directory(state: Path) -> None:
    """Raise `BackupError` if the folder must not be erased, before an operator is asked to erase it."""
    try:
        reason = foreign(state.absolute()) or _needed(state.absolute())
    except OSError as error:
        reason = with_remedy(error, state)
    if reason is not None:
        raise BackupError(reason)


def _needed(state: Path) -> str | None:
    obstacles = (obstacle(state) for obstacle in members("state_files", "obstacle_to_purge"))
    return next(filter(None, obstacles), None)


def purge(state: Path) -> tuple[int, int]:
    """Erase the state directory; return how many files were removed, and how many of them were overwritten.

    A mount point stays as an empty folder. Raises `BackupError`.
    """
    state = state.absolute()
    try:
        reason = foreign(state)
        if not state.is_dir() or reason is not None:
            raise BackupError(reason or f"the state directory {state} does not exist: give it with --state")
        if not any(state.iterdir()):
            raise BackupError(f"{state} is empty: nothing to purge")
        lock = StateDirectory(state)
    except StartError as error:
        raise BackupError(str(error)) from None
    except OSError as error:
        raise BackupError(with_remedy(error, state)) from error
    try:
        if (reason := _needed(state)) is not None:
            raise BackupError(reason)
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
            f"{with_remedy(error, error.filename or state)}; the remaining files are unchanged"
        ) from error
    finally:
        lock.close()
    try:
        state.rmdir()
    except OSError as error:
        if error.errno == errno.ENOTEMPTY:
            raise BackupError(f"{state}: it has new files; run this again") from error
        # A mount point, or this user may not write to the folder around it: it stays, empty.
    return counts


def _write_over(state: Path) -> tuple[int, int]:
    files = written = 0
    for _folder, _folders, names, at in os.fwalk(state, follow_symlinks=False):
        for name in names:
            files += 1
            written += write_over(name, at)
    return files, written
