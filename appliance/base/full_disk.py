"""Recognise a full disk behind an error of SQLite or the system.

SQLite reports a full disk as `disk I/O error` if it meets it at its write-ahead log or shared memory.
"""

import errno
import os
import sqlite3
from pathlib import Path

_WRITING = frozenset({sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN})
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
_ROOM = 128 << 10  # bytes: SQLite's shared memory grows by 32 KiB, a write-ahead log by a few pages


def is_full(error: BaseException, folder: Path) -> bool:
    """Return whether an error is that of a full disk, which `folder` is on."""
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF  # without its extension
    if code == sqlite3.SQLITE_FULL or getattr(error, "errno", None) in _FULL:
        return True
    if code not in _WRITING:
        return False
    try:
        disk = os.statvfs(folder)
    except OSError:
        return False
    return disk.f_bavail * disk.f_frsize < _ROOM or (disk.f_files > 0 and not disk.f_favail)


def reason_of(error: BaseException, folder: Path) -> str:
    """Return an error's text, which names a full disk."""
    return f"{error}: the disk of {folder} is full" if is_full(error, folder) else str(error)
