"""Restore a state directory from a backup.

1. No file is overwritten, and writing starts only after the whole archive was checked.
2. An incomplete restore never becomes an appliance's state: until everything is on the disk, a mark makes `rosrv up`
   reject the directory.
3. The files in a folder get their owner before the folder does. Otherwise the new owner could replace files with
   links.
"""

import os
import shutil
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from appliance.backup.contents import KEPT_PARTS, BackupError
from appliance.features.backup.archive import checked_archive
from appliance.supervisor.restore_mark import set_mark
from appliance.supervisor.roles import ROLES
from appliance.supervisor.users import account_of

_LOCK = "lock"  # `StateDirectory` recognizes the directory by this file, even if root cannot read the parts
_OF_THE_DISK = "lost+found"
_SPARE = 64 << 20  # bytes of the disk that stay free


def restore(file: Path, state: Path) -> list[str]:
    with checked_archive(file, _room_in(state)) as (archive, entries), _marked(state):
        for entry in entries:
            _extract(archive, entry, state)
        if os.geteuid() == 0:
            _hand_over(state)
        os.sync()
    return [entry.name for entry in entries]


def _room_in(state: Path) -> int:
    try:
        if os.path.lexists(state) and any(entry.name != _OF_THE_DISK for entry in state.iterdir()):
            raise BackupError(f"{state} is not empty, and nothing is overwritten; name another --state")
        here = state.absolute()
        while not os.path.lexists(here):
            here = here.parent
        disk = os.statvfs(f"{here}/.")  # `/.` fails for a file
    except OSError as error:
        raise BackupError(f"{state}: {error.strerror}; name another --state") from error
    return disk.f_bavail * disk.f_frsize - _SPARE


@contextmanager
def _marked(state: Path) -> Iterator[None]:
    """Mark the directory as incomplete. On an error, remove everything that was created."""
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
    """Give each part to its role's user, and the group of its files to the role that may read them."""
    for role in (role for role in ROLES if role.part in KEPT_PARTS):
        account = account_of(role.user)
        group = account.gid if role.readable_by is None else account_of(role.readable_by).gid
        part = state / role.part
        for path in (*sorted(part.rglob("*"), reverse=True), part) if part.exists() else ():
            os.chown(path, account.uid, account.gid if path.is_dir() else group, follow_symlinks=False)
