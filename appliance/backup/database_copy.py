"""A database of a state directory, copied by SQLite as of one moment, while its process may go on writing.

SQLite opens it, and the write-ahead log beside it, by name. Whoever owns the folder could put a link in its place after
it was looked at; so root reads with the rights of the owner and no others, and a link leads where he may read himself.
"""

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from appliance.backup.contents import BackupError

_BUSY_SECONDS = 30


def copy_database(path: Path, owner: os.stat_result, copy: Path) -> None:
    """Copy the database at `path`, whose file was `owner`'s a moment ago, to the new file `copy`.

    Raises `BackupError`, `OSError`, `sqlite3.Error`.
    """
    with closing(sqlite3.connect(copy)) as target:
        target.execute("PRAGMA journal_mode = OFF")  # the owner may make no file beside the copy
        with _rights_of(owner):
            if not os.access(path, os.R_OK, effective_ids=True):
                raise BackupError(
                    f"{path} cannot be read by user id {owner.st_uid}, whose it is: every folder above it must let"
                    " that user pass, and it must be a file of that user's own"
                )
            uri = f"{path.absolute().as_uri()}?mode=ro"
            with closing(sqlite3.connect(uri, uri=True, timeout=_BUSY_SECONDS)) as source:
                source.backup(target)


@contextmanager
def _rights_of(owner: os.stat_result) -> Iterator[None]:
    """Of root, only the rights of `owner`, for a while; who is not root has no others to give up."""
    if os.geteuid() != 0 or owner.st_uid == 0:
        yield
        return
    group, groups = os.getegid(), os.getgroups()
    os.setgroups([])
    try:
        os.setegid(owner.st_gid)
        os.seteuid(owner.st_uid)
        yield
    finally:
        os.seteuid(0)
        os.setegid(group)
        os.setgroups(groups)
