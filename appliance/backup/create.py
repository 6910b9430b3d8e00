"""Write the state directory of a running appliance to one file, for `restore.py`.

1. SQLite copies each database as a consistent snapshot.
2. The log is copied first. Then the signer's memory is cut to the checkpoints in that copy, so that a restored log
   can be continued.
3. `state.ahead` has acknowledged changes that `state.db` lacks. It is copied before `state.db`, so each change is in
   at least one of them; a start skips those in both.
4. The file contains keys, so only its owner may read it.
5. Root reads folders of users whose processes may be compromised. Therefore links are not followed with root's
   rights, and a file that belongs to another user is an error.
"""

import errno
import os
import signal
import sqlite3
import stat
import tarfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from types import FrameType
from typing import BinaryIO

from appliance.backup.contents import (
    AUDIT_LOG,
    KEPT_PARTS,
    LARGEST,
    MAX_FILES,
    BackupError,
    comes_and_goes,
    is_database,
    trouble_with,
)
from appliance.base import clock
from appliance.base.full_disk import is_full
from appliance.supervisor.errors import StartError
from appliance.supervisor.restore_mark import refuse_half_restored

_PIECE = 1 << 20
_HEADER, _HASH = 8, 32  # bytes, of the signer's memory
_FORMAT = tarfile.GNU_FORMAT  # this format stores even the size of a large database in a single header
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_FILE = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # opening a pipe does not block
_NO_RIGHTS = {sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_AUTH}
_ADVICE = "run this as root with the capability DAC_OVERRIDE (in a container: docs/operating.md)"


Seen = Callable[[str, Path], None]
"""Gets each name in the archive, and the copy that was archived."""


def back_up(state: Path, file: Path, seen: Seen = lambda _name, _copy: None) -> list[str]:
    """Write the backup; return the names in the tar archive. Raises `BackupError`."""
    try:
        refuse_half_restored(state)
    except StartError as error:
        raise BackupError(str(error)) from None
    if not (state / AUDIT_LOG).exists():
        raise BackupError(
            f"{state} has no audit log: it is not the state directory of an appliance (--state)"
        )
    with _signals_interrupt():
        return _back_up(state, file, seen)


@contextmanager
def _signals_interrupt() -> Iterator[None]:
    """Raise `KeyboardInterrupt` for the first signal of `docker stop`, of systemd, or of a closed terminal.

    Later ones are ignored, because a shell and the kernel both send SIGHUP. With `nohup` it stays ignored.
    """
    ours = [
        number for number in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(number) == signal.SIG_DFL
    ]

    def set_all(handler: Callable[[int, FrameType | None], None] | signal.Handlers) -> None:
        for number in ours:
            signal.signal(number, handler)

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        set_all(signal.SIG_IGN)
        raise KeyboardInterrupt

    set_all(interrupt)
    try:
        yield
    finally:
        set_all(signal.SIG_DFL)


def _back_up(state: Path, file: Path, seen: Seen) -> list[str]:
    try:
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        raise BackupError(f"{file} already exists: choose another name") from None
    except OSError as error:
        raise BackupError(f"{file}: {error.strerror}") from error
    try:
        with (
            os.fdopen(descriptor, "wb") as raw,
            tarfile.open(fileobj=raw, mode="w:gz", format=_FORMAT) as archive,
        ):
            names = _write(state, archive, file.absolute().parent, seen)
            archive.close()
            raw.flush()
            os.fsync(raw.fileno())
    except BaseException as error:  # also Ctrl-C and signals
        file.unlink()
        if isinstance(error, (OSError, sqlite3.Error)):
            beside = file.absolute().parent
            if is_full(error, beside):
                reason = f"{beside}: the disk is full; free space there, or write the file elsewhere"
            elif is_full(error, state):
                reason = f"{state}: the disk is full; free space there"
            else:
                reason = f"{error}; {_ADVICE}" if _lacks_rights(error) else str(error)
            raise BackupError(f"the backup was not made: {reason}") from error
        raise
    return names


def _lacks_rights(error: OSError | sqlite3.Error) -> bool:
    if isinstance(error, OSError):
        return isinstance(error, PermissionError)
    return getattr(error, "sqlite_errorcode", 0) & 0xFF in _NO_RIGHTS


def _write(state: Path, archive: tarfile.TarFile, beside: Path, seen: Seen) -> list[str]:
    names = []
    with TemporaryDirectory(prefix=".rosrv-backup-", dir=beside) as folder:
        copy = Path(folder) / "copy.db"
        last: dict[str, int] = {}
        for name, descriptor in _files(state):
            with os.fdopen(descriptor, "rb") as file:
                mode = os.fstat(descriptor).st_mode & 0o777
                if trouble := trouble_with(name, os.fstat(descriptor).st_size):
                    raise BackupError(f"{name} {trouble}: find out its origin, and remove it")
                if is_database(name):
                    copy_database(state / name, os.fstat(descriptor), copy)
                else:
                    _copy_file(name, file, copy, last)
            if name == AUDIT_LOG:
                last = _last_checkpoint(copy)
            entry = tarfile.TarInfo(name)
            entry.size, entry.mtime, entry.mode = copy.stat().st_size, int(clock.wall()), mode
            with copy.open("rb") as content:
                archive.addfile(entry, content)
            seen(name, copy)
            copy.unlink()
            names.append(name)
    return names


def _files(state: Path) -> Iterator[tuple[str, int]]:
    """Yield the log first; the others are listed after it is copied, so the key for its signatures exists by then."""
    log = open_file(state, AUDIT_LOG) if (state / AUDIT_LOG).exists() else None
    if log is not None:
        yield AUDIT_LOG, log
    names = [
        name
        for part in sorted(KEPT_PARTS)
        if (state / part).exists()  # a role that never ran here has no part
        for name in _names(state, part)
    ]
    if len(names) > MAX_FILES:
        parts = Counter(name.partition("/")[0] for name in names)
        raise BackupError(
            f"{state} has more than {MAX_FILES} files, most of them in {parts.most_common(1)[0][0]}: find out their"
            " origin, and remove them"
        )
    for name in names:
        descriptor = open_file(state, name) if name != AUDIT_LOG else None
        if descriptor is not None:
            yield name, descriptor


def _names(state: Path, part: str) -> Iterator[str]:
    # An unreadable folder is an error: a backup without the keys would be useless.
    for folder, folders, names in os.walk(state / part, onerror=_raise):
        folders.sort()
        for name in sorted(names):  # `state.ahead` comes before `state.db`
            kept = (Path(folder) / name).relative_to(state).as_posix()
            if not comes_and_goes(kept):
                yield kept


def open_file(state: Path, name: str) -> int | None:
    """Open a file of the state, following no link; return None if it is not a regular file.

    Raises `BackupError` for a wrong owner.
    """
    part, *folders, last = PurePosixPath(name).parts
    here = os.open(state / part, _FOLDER)
    owner = os.fstat(here).st_uid
    try:
        for folder in folders:
            outer, here = here, os.open(folder, _FOLDER, dir_fd=here)
            os.close(outer)
        descriptor = os.open(last, _FILE, dir_fd=here)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO):  # the file is a link or a socket
            return None
        raise
    finally:
        os.close(here)
    found = os.fstat(descriptor)
    if stat.S_ISREG(found.st_mode) and found.st_uid == owner:
        return descriptor
    os.close(descriptor)
    if stat.S_ISREG(found.st_mode):
        raise BackupError(
            f"{state / name} belongs to user id {found.st_uid}, and its part to {owner}: see who put it there, and take"
            " it away"
        )
    return None


def _copy_file(name: str, file: BinaryIO, copy: Path, last: dict[str, int]) -> None:
    if name.endswith(".signed"):
        copy.write_bytes(_as_far_as(file.read(LARGEST), last.get(PurePosixPath(name).stem)))
        return
    with copy.open("wb") as written:
        while piece := file.read(_PIECE):
            written.write(piece)
            if written.tell() > LARGEST:  # the file grew while it was read
                raise BackupError(f"{name} has more than {LARGEST} bytes: find out its origin, and remove it")


def _raise(error: OSError) -> None:
    raise error


def _last_checkpoint(log: Path) -> dict[str, int]:
    with closing(sqlite3.connect(log)) as connection:
        (log_id,) = connection.execute("SELECT id FROM log").fetchone()
        (number,) = connection.execute("SELECT coalesce(max(number), 0) FROM checkpoint").fetchone()
    return {str(log_id): int(number)}


def _as_far_as(memory: bytes, number: int | None) -> bytes:
    if number is None or len(memory) < _HEADER:
        return memory
    first = int.from_bytes(memory[:_HEADER], "big")
    return memory[: _HEADER + max(0, number - first + 1) * _HASH]


_BUSY_SECONDS = 30


def copy_database(path: Path, owner: os.stat_result, copy: Path) -> None:
    """Copy a database; `owner` is its file status. Raises `BackupError`, `OSError`, `sqlite3.Error`.

    SQLite opens the database and its write-ahead log by name. The folder's owner could replace either by a link, so
    root reads them with only the owner's rights.
    """
    with closing(sqlite3.connect(copy)) as target:
        target.execute("PRAGMA journal_mode = OFF")  # the owner cannot create a file beside the copy
        with _rights_of(owner):
            if not os.access(path, os.R_OK, effective_ids=True):
                raise BackupError(
                    f"{path} cannot be read by its owner, user id {owner.st_uid}: that user must own the file and"
                    " have access to every folder above it"
                )
            uri = f"{path.absolute().as_uri()}?mode=ro"
            with closing(sqlite3.connect(uri, uri=True, timeout=_BUSY_SECONDS)) as source:
                source.backup(target)


@contextmanager
def _rights_of(owner: os.stat_result) -> Iterator[None]:
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
