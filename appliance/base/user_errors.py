"""Errors for users: their base class, and the words for errors of the system. Imports the standard library only."""

import errno
from pathlib import Path


class UserError(Exception):
    """An error for users: `rosrv` prints the text and exits with status 1."""


_REMEDIES = {
    errno.EACCES: "run this as root",
    errno.EDQUOT: "free some space, or name another disk",
    errno.EEXIST: "name a new file",
    errno.EISDIR: "name a file",
    errno.ENOSPC: "free some space, or name another disk",
    errno.EPERM: "run this as root",
    errno.EROFS: "name a place that can be written",
}


def with_remedy(error: OSError, place: object = None) -> str:
    """Return the text for users; `place` is the file if the error does not name it."""
    where = error.filename if place is None else place
    why = error.strerror or str(error)
    remedy = _REMEDIES.get(error.errno or 0, "")
    if isinstance(error, FileNotFoundError) and where and not Path(str(where)).absolute().parent.is_dir():
        remedy = "create its folder first"
    return "; ".join(filter(None, (f"{where}: {why}" if where else why, remedy)))
