"""Files that are there as a whole or not at all, whatever dies meanwhile."""

import contextlib
import os
import re
import secrets
import stat
import sys
from pathlib import Path

_UNFINISHED = re.compile(r".+\.[0-9a-f]{8}\.new(-journal)?")
"""What `name_to_make` gives; beside a database there is a journal."""


class NotLastingError(OSError):
    """The file is replaced, and may be as it was before after a power cut: the disk did not say that it has it."""


def name_to_make(path: Path) -> Path:
    """Where a file is made that gets this name when it is whole: under one of its own, which nothing left has."""
    return path.with_name(f"{path.name}.{secrets.token_hex(4)}.new")


def remove_unfinished(folder: str, place: int) -> None:
    """Take away what writers of a folder of `place` (a descriptor), and of those in it, were killed over.

    None of them may be at work. What cannot be removed stays: it keeps nobody from writing.
    """
    with contextlib.suppress(OSError):
        for _path, _folders, files, inside in os.fwalk(folder, follow_symlinks=False, dir_fd=place):
            for name in filter(_UNFINISHED.fullmatch, files):
                if stat.S_ISREG(os.stat(name, dir_fd=inside, follow_symlinks=False).st_mode):
                    os.unlink(name, dir_fd=inside)


def write_whole(path: Path, data: bytes, mode: int, owner: tuple[int, int] | None = None) -> None:
    """Replace a file, on the disk when this returns. Raises `OSError`; the file before is then as it was.

    It is of `owner` (user and group), or of who writes it, before it has its name. Of several who write it at once it
    is one's, whole. Raises `NotLastingError` when it is replaced, but not surely on the disk.
    """
    making = name_to_make(path)
    try:
        descriptor = os.open(
            making, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600
        )
        try:
            with os.fdopen(descriptor, "wb") as file:
                if owner is not None:
                    os.fchown(descriptor, *owner)
                os.fchmod(descriptor, mode)  # whatever the mask is: the folder says who comes by
                file.write(data)
                file.flush()
                os.fsync(descriptor)
            making.rename(path)
        except BaseException:
            making.unlink()
            raise
    except OSError as error:  # a full disk: the system does not say of which file
        raise OSError(error.errno, error.strerror, str(path)) from error
    try:
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(folder)  # else the file before could come back with the power
        finally:
            os.close(folder)
    except OSError as error:
        why = f"it is replaced, and may be as before after a power cut: {error.strerror}"
        raise NotLastingError(error.errno, why, str(path)) from error


def write_where_told(path: Path, data: bytes) -> None:
    """Write what somebody wants at a place of his choice. Raises `OSError`.

    A file is replaced as a whole and keeps its mode and owner, also behind a link. What is no file (a pipe, a device),
    or has an owner that this process cannot give it again, is written into; and so is what this process's own output
    goes to (/dev/stdout), behind what it has said.
    """
    try:
        there = path.stat()
    except FileNotFoundError:
        write_whole(path, data, 0o644)
        return
    for stream in filter(None, (sys.stdout, sys.stderr)):
        with contextlib.suppress(OSError, ValueError):  # it is closed, or is no file
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
