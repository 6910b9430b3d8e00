"""A state directory made of a backup.

Invariants:

1. Nothing is written over, and nothing is written before the archive was checked to its end (`backup_archive`).
2. A restore that did not come to its end is never taken for an appliance's state: what it made is taken away, and
   where that was not possible (a kill, a power cut) the mark that it set first is still there, which `rosrv up`
   refuses. The mark goes when everything is on the disk.
3. What is in a folder is given away before the folder: its user could put a link in the place of what is in it.
"""

import os
import shutil
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from appliance.backup.archive import checked_archive
from appliance.backup.contents import KEPT_PARTS, BackupError
from appliance.supervisor.restore_mark import set_mark
from appliance.supervisor.roles import ROLES
from appliance.supervisor.users import account_of

_LOCK = "lock"  # by it `StateDirectory` knows an appliance's directory, also where root may not look into its parts
_OF_THE_DISK = "lost+found"
_SPARE = 64 << 20  # bytes of a disk that are left for others


def restore(file: Path, state: Path) -> list[str]:
    """Make the state directory `state` of a backup, for `rosrv up --state` there; the names of what is in it.

    As root each part is given to its user. Raises `BackupError`.
    """
    with checked_archive(file, _room_in(state)) as (archive, entries), _marked(state):
        for entry in entries:
            _extract(archive, entry, state)
        if os.geteuid() == 0:
            _hand_over(state)
        os.sync()
    return [entry.name for entry in entries]


def _room_in(state: Path) -> int:
    """Bytes for which there is room on the disk of an empty folder, or of one that is not there yet.

    Raises `BackupError`.
    """
    try:
        if os.path.lexists(state) and any(entry.name != _OF_THE_DISK for entry in state.iterdir()):
            raise BackupError(f"{state} is not empty: nothing is written over; name another --state")
        here = state.absolute()
        while not os.path.lexists(here):
            here = here.parent
        disk = os.statvfs(f"{here}/.")  # which only a folder has
    except OSError as error:
        raise BackupError(f"{state}: {error.strerror}; name another --state") from error
    return disk.f_bavail * disk.f_frsize - _SPARE


@contextmanager
def _marked(state: Path) -> Iterator[None]:
    """The mark while it is being restored; on any error nothing of what was made is left."""
    is_new = not state.exists()
    state.mkdir(mode=0o711, parents=True, exist_ok=True)
    state.chmod(0o711)
    mark = set_mark(state)
    try:
        (state / _LOCK).touch(0o600, exist_ok=False)
        yield
    except BaseException:
        for part in KEPT_PARTS:
            if (state / part).exists():
                shutil.rmtree(state / part)
        (state / _LOCK).unlink(missing_ok=True)
        mark.unlink()
        if is_new:
            state.rmdir()
        raise
    mark.unlink()


def _extract(archive: tarfile.TarFile, entry: tarfile.TarInfo, state: Path) -> None:
    target = state / entry.name
    for folder in reversed(target.relative_to(state).parents[:-1]):
        (state / folder).mkdir(mode=0o700, exist_ok=True)
    source = archive.extractfile(entry)
    assert source is not None  # noqa: S101  the archive has regular files only
    descriptor = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with source, os.fdopen(descriptor, "wb") as written:
        shutil.copyfileobj(source, written, 1 << 20)
        os.fchmod(descriptor, entry.mode & 0o755)


def _hand_over(state: Path) -> None:
    """Give each part to its role's user; the files in it that others may read, to the group that may."""
    for role in (role for role in ROLES if role.part in KEPT_PARTS):
        account = account_of(role.user)
        group = account.gid if role.readable_by is None else account_of(role.readable_by).gid
        part = state / role.part
        for path in (*sorted(part.rglob("*"), reverse=True), part) if part.exists() else ():
            os.chown(path, account.uid, account.gid if path.is_dir() else group, follow_symlinks=False)
