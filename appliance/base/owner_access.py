"""Open a file that an operator names, even where only its owner may reach it.

1. A process first uses its own rights.
2. Root then acts as the owner of the folder, and after that as the owner of the file: in a container, root lacks
   CAP_DAC_OVERRIDE. The rights of the folder's owner also decide about symbolic links, so users cannot have root
   open another user's file by a link. As the owner of the file, root follows no link.
3. A role of the appliance asks the supervisor (`supervisor/input_lender.py`).
"""

import contextlib
import ctypes
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar

from appliance.base.user_errors import UserError

OPENING = os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
"""Flags of `open` with which a pipe or a device does not block the caller."""

_PASSING = os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC


class MissingRightError(UserError, PermissionError):
    """A container has taken a right from root, and nothing else can replace it."""


class FileLender:
    """Opens files for a role of the appliance; `open` returns None if the role may not ask for the file."""

    # A setting of the process, as its user is: each reader of a named file would otherwise have to pass it on.
    open: ClassVar[Callable[[Path], int | None]] = lambda _path: None

    @classmethod
    def install(cls, opened: Callable[[Path], int | None]) -> None:
        cls.open = opened


def open_named(path: Path) -> int:
    """Open a file or folder that an operator names. Raises `OSError`."""
    try:
        return os.open(path, OPENING)
    except PermissionError:
        lent = open_as_owner(path) if os.geteuid() == 0 else FileLender.open(path)
        if lent is None:
            raise
    except FileNotFoundError:  # perhaps only in a role's private view
        if (lent := FileLender.open(path)) is None:
            raise
    return lent


def is_named_there(path: Path) -> bool:
    """Return whether the path exists, checked with the rights that open it: root's own may not suffice."""
    try:
        os.close(open_named(path))
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:  # it exists, and its reader reports why it cannot be used
        return True
    return True


def open_as_owner(path: Path) -> int:
    """Open a file with the rights of the folder's owner, or of its own. Raises `OSError`."""
    return _open_in(_folder(path.absolute().parent), path.name, path)


def open_below(folder: Path, path: Path) -> int:
    """Open a file below a folder; no folder between them may be a link. Raises `OSError`."""
    place = _folder(folder)
    for name in path.relative_to(folder).parent.parts:
        place = _next(place, name, os.O_NOFOLLOW)
    return _open_in(place, path.name, path)


@contextlib.contextmanager
def acting_as(uid: int) -> Iterator[None]:
    """Act as a user during the block; a process without root changes nothing."""
    # seteuid would also take root from the other threads.
    if os.geteuid() != 0 or uid == 0:
        yield
        return
    setfsuid = ctypes.CDLL(None).setfsuid
    setfsuid(uid)
    try:
        if setfsuid(-1) != uid:  # setfsuid reports no error; -1 only queries
            raise MissingRightError(f"cannot act as user id {uid}: CAP_SETUID is missing")
        yield
    finally:
        setfsuid(0)


@contextlib.contextmanager
def acting_as_owner(folder: Path) -> Iterator[None]:
    """Act as the owner of a folder, if it exists: in a container, root may not use the folders of other users."""
    with acting_as(folder.stat().st_uid) if folder.exists() else contextlib.nullcontext():
        yield


def _folder(path: Path) -> int:
    try:
        return os.open(path, _PASSING)
    except PermissionError:
        if path.parent == path:
            raise
    return _next(_folder(path.parent), path.name)


def _next(place: int, name: str, flags: int = 0) -> int:
    try:
        with acting_as(os.fstat(place).st_uid):
            return os.open(name, _PASSING | flags, dir_fd=place)
    finally:
        os.close(place)


def _open_in(place: int, name: str, path: Path) -> int:
    try:
        with acting_as(os.fstat(place).st_uid):
            try:
                return os.open(name, OPENING, dir_fd=place)
            except PermissionError:
                about = os.stat(name, dir_fd=place, follow_symlinks=False)
                if stat.S_ISLNK(about.st_mode):
                    raise
        with acting_as(about.st_uid):
            return os.open(name, OPENING | os.O_NOFOLLOW, dir_fd=place)
    except OSError as error:
        error.filename = str(path)
        raise
    finally:
        os.close(place)
