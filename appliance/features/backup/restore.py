"""Restore a state directory from a backup.

1. No file is overwritten, and writing starts only after the whole archive was checked.
2. An incomplete restore never becomes an appliance's state: until everything is on the disk, a mark makes `rosrv up`
   reject the directory.
3. The files in a folder get their owner before the folder does. Otherwise the new owner could replace files with
   links.
"""

import gzip
import os
import shutil
import tarfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import BinaryIO, Self

from appliance.backup.contents import AUDIT_LOG, KEPT_PARTS, MAX_FILES, BackupError, belongs, trouble_with
from appliance.base.input_files import open_given
from appliance.supervisor.restore_mark import set_mark
from appliance.supervisor.roles import ROLES
from appliance.supervisor.users import account_of

# Check an archive before it is restored: it is complete, and has only entries that `back_up` writes.
#
# 1. The checksum of the whole file is checked before any entry is used.
# 2. An archive must fit into the free space, and have at most `MAX_FILES` regular files. Headers that modify the
#    next entry (sparse, pax, long names) are rejected, so exactly the checked entries are extracted. Every name is
#    valid for a backup and occurs once.

_PIECE = 1 << 20


class _StrangeEntryError(Exception):
    """An entry has a header type that backups never contain."""


class _PlainEntry(tarfile.TarInfo):
    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> Self:
        entry = super().frombuf(buf, encoding, errors)
        if entry.type not in (tarfile.REGTYPE, tarfile.AREGTYPE):
            raise _StrangeEntryError(entry.name)
        return entry


@contextmanager
def checked_archive(file: Path, room: int) -> Iterator[tuple[tarfile.TarFile, list[tarfile.TarInfo]]]:
    """Open an archive and check it, with at most `room` unpacked bytes.

    Raise `BackupError`, including for read errors inside the `with` block.
    """
    try:
        with open_given(file) as raw:
            _read_to_the_end(file, raw, room)
            raw.seek(0)
            with (
                gzip.open(raw, "rb") as unpacked,
                tarfile.open(fileobj=unpacked, mode="r:", tarinfo=_PlainEntry) as archive,
            ):
                yield archive, _entries(file, archive)
    except _StrangeEntryError as error:
        raise _strange(file, str(error)) from None
    except (OSError, tarfile.TarError, EOFError, ValueError, zlib.error) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        if isinstance(error, gzip.BadGzipFile):
            reason = "it is not a file of rosrv backup"
        raise BackupError(f"{file} cannot be restored: {reason}") from error


def _read_to_the_end(file: Path, raw: BinaryIO, room: int) -> None:
    size = 0
    with gzip.open(raw, "rb") as unpacked:
        while piece := unpacked.read(_PIECE):
            size += len(piece)
            if size > room:
                raise BackupError(
                    f"{file} unpacks to more than the {max(0, room) >> 20} MiB of free space:"
                    " nothing is restored"
                )


def _entries(file: Path, archive: tarfile.TarFile) -> list[tarfile.TarInfo]:
    parts = KEPT_PARTS
    entries: dict[str, tarfile.TarInfo] = {}
    while (entry := archive.next()) is not None:
        if entry.name in entries or not belongs(entry.name, parts) or trouble_with(entry.name, entry.size):
            raise _strange(file, entry.name)
        if len(entries) == MAX_FILES:
            raise BackupError(
                f"{file} has more than {MAX_FILES} files, more than any backup: nothing is restored"
            )
        entries[entry.name] = entry
    folders = {str(folder) for name in entries for folder in PurePosixPath(name).parents}
    for name in folders & entries.keys():
        raise _strange(file, name)
    if AUDIT_LOG not in entries:
        raise BackupError(f"{file} has no audit log: it is not a backup of an appliance")
    return list(entries.values())


def _strange(file: Path, name: str) -> BackupError:
    return BackupError(f"{file} contains {name[:200]!r}, which is not part of a backup: nothing is restored")


_LOCK = "lock"  # `StateDirectory` recognizes the directory by this file, even if root cannot read the parts
_OF_THE_DISK = "lost+found"
_SPARE = 64 << 20  # bytes of the disk that stay free


def restore(file: Path, state: Path) -> list[str]:
    with checked_archive(file, _room_in(state)) as (archive, entries), _mark(state):
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
def _mark(state: Path) -> Iterator[None]:
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
