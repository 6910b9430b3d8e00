import errno
import os
import sqlite3
from pathlib import Path
from types import SimpleNamespace

import pytest

from appliance.base.full_disk import is_full, reason_of

FULL = SimpleNamespace(f_bavail=7, f_frsize=4096, f_files=100, f_favail=50)
NO_FILES = SimpleNamespace(f_bavail=1 << 20, f_frsize=4096, f_files=100, f_favail=0)
WIDE = SimpleNamespace(f_bavail=1 << 20, f_frsize=4096, f_files=0, f_favail=0)


def sqlite(code: int) -> sqlite3.OperationalError:
    error = sqlite3.OperationalError("disk I/O error")
    error.sqlite_errorcode = code
    return error


@pytest.mark.parametrize(
    ("error", "disk", "full"),
    [
        (sqlite(sqlite3.SQLITE_IOERR_SHMSIZE), FULL, True),
        (sqlite(sqlite3.SQLITE_IOERR_WRITE), NO_FILES, True),
        (sqlite(sqlite3.SQLITE_CANTOPEN), FULL, True),
        (sqlite(sqlite3.SQLITE_IOERR_READ), WIDE, False),
        (sqlite(sqlite3.SQLITE_FULL), WIDE, True),
        (sqlite(sqlite3.SQLITE_CORRUPT), FULL, False),
        (OSError(errno.ENOSPC, "no space"), WIDE, True),
        (OSError(errno.EACCES, "no rights"), FULL, False),
    ],
)
def test_a_full_disk_is_called_that(
    error: Exception, disk: SimpleNamespace, full: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "statvfs", lambda _folder: disk)
    assert is_full(error, Path("/state")) is full
    assert reason_of(error, Path("/state")).endswith(": the disk of /state is full") is full
