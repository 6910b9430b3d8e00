"""The mark of a state directory whose restore did not come to its end: set first, taken away last.

It is a file of its own module because who starts an appliance asks for it, and needs nothing else of backups.
"""

import os
from pathlib import Path

from appliance.supervisor.errors import StartError


def set_mark(state: Path) -> Path:
    """Mark `state`, a folder that has nothing in it. Raises `OSError`, also where it is marked already."""
    mark = _mark(state)
    os.close(os.open(mark, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600))
    return mark


def refuse_half_restored(state: Path) -> None:
    """To be called before `state` is used. Raises `StartError` where it is marked."""
    if os.path.lexists(_mark(state)):
        raise StartError(
            f"{state}: a backup was not put back to its end: remove it, and `rosrv restore` once more"
            " (while that is still at work, wait)"
        )


def _mark(state: Path) -> Path:
    return state / "restoring"
