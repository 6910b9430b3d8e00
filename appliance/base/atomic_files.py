"""Write files atomically: a crash leaves the old file or the new one, never a part."""

import contextlib
import os
import re
import secrets
import stat
import sys
from mmap import mmap
from pathlib import Path

_UNFINISHED = re.compile(r".{1,255}\.[0-9a-f]{8}\.new(-journal)?")
"""Names that `name_to_make` returns, and journals of databases with such names."""


class NotLastingError(OSError):
    """The file is replaced, but after a power cut the old one may be back."""


def name_to_make(path: Path) -> Path:
    return path.with_name(f"{path.name}.{secrets.token_hex(4)}.new")


def remove_unfinished(folder: str, place: int) -> None:
    """Remove files that a crash left unfinished; no writer may be active. `folder` is relative to `place`."""
    with contextlib.suppress(OSError):
        for _path, _folders, files, inside in os.fwalk(folder, follow_symlinks=False, dir_fd=place):
            for name in filter(_UNFINISHED.fullmatch, files):
                if stat.S_ISREG(os.stat(name, dir_fd=inside, follow_symlinks=False).st_mode):
                    os.unlink(name, dir_fd=inside)


def write_whole(path: Path, data: bytes | mmap, mode: int, owner: tuple[int, int] | None = None) -> None:
    """Replace a file. Raises `OSError`, which leaves the old file unchanged, and `NotLastingError` if the new file is
    perhaps not on the disk.

    `owner` (user and group) is set before the file gets its final name. Concurrent writers leave one complete file.
    """
    making = name_to_make(path)
    try:
        descriptor = os.open(
            making, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600
        )
        try:
            with os.fdopen(descriptor, "wb") as file:
                os.fchmod(descriptor, mode)  # independent of the umask: the folder restricts access
                if owner is not None:  # last: in a container, root may not change another user's file
                    os.fchown(descriptor, *owner)
                file.write(data)
                file.flush()
                os.fsync(descriptor)
            making.rename(path)
        except BaseException:
            making.unlink()
            raise
    except OSError as error:  # a full disk: the system does not name the file
        raise OSError(error.errno, error.strerror, str(path)) from error
    try:
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(folder)  # otherwise the old file could return after a power cut
        finally:
            os.close(folder)
    except OSError as error:
        why = f"it is replaced, but a power cut may restore the old content: {error.strerror}"
        raise NotLastingError(error.errno, why, str(path)) from error


def write_where_told(path: Path, data: bytes | mmap) -> None:
    """Write to the path that a person named. Raises `OSError`.

    A regular file is replaced atomically and keeps its mode and owner, even behind a symbolic link. A pipe, a device,
    or a file with an owner that this process cannot set is written in place. The process's own output (/dev/stdout)
    is appended to.
    """
    try:
        there = path.stat()
    except FileNotFoundError:
        write_whole(path, data, 0o644)
        return
    for stream in filter(None, (sys.stdout, sys.stderr)):
        with contextlib.suppress(OSError, ValueError):  # the stream is closed or is not a file
            if os.path.samestat(there, os.fstat(stream.fileno())):
                stream.flush()
                with os.fdopen(os.dup(stream.fileno()), "wb") as output:
                    output.write(data)
                return
    user, groups = os.geteuid(), {os.getegid(), *os.getgroups()}
    keeps = user == 0 or (there.st_uid == user and there.st_gid in groups)
    if not (keeps and stat.S_ISREG(there.st_mode)):
        path.write_bytes(data)
        return
    write_whole(path.resolve(), data, stat.S_IMODE(there.st_mode), (there.st_uid, there.st_gid))
