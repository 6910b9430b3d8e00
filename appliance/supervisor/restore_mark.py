"""Mark a state directory while a backup is restored to it, so that an unfinished restore is detected."""

import os
from pathlib import Path

from appliance.supervisor.errors import StartError


def set_mark(state: Path) -> Path:
    """Mark the directory; return the mark. Raises `OSError`, even if the directory is already marked."""
    mark = _mark(state)
    os.close(os.open(mark, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600))
    return mark


def refuse_half_restored(state: Path) -> None:
    """Raise `StartError` if a restore did not finish; call this before `state` is used."""
    if os.path.lexists(_mark(state)):
        raise StartError(
            f"{state}: a restore did not finish: remove this folder, and run `rosrv restore` again"
            " (if it is still running, wait)"
        )


def _mark(state: Path) -> Path:
    return state / "restoring"
