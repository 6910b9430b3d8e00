"""Make the program visible to a process whose user may not reach it, such as a checkout in a home of mode 0700.

1. The view is a mount namespace of the process: no other process sees a difference, and no file is changed.
2. Each closed folder is covered by an empty, read-only folder with only the program and the state, so the process
   reaches less of a home than if it could pass through.
3. The program is mounted read-only. If its files are readable only by their owner (umask 077), the owner is mapped to
   the process's user.
"""

import contextlib
import ctypes
import errno
import os
import socket
import stat
import struct
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import appliance
from appliance.supervisor.errors import StartError
from appliance.supervisor.privileges import libc_call
from appliance.supervisor.sandbox.landlock import system_call
from appliance.supervisor.users import Account

_PARTS = ("appliance", "roswire", "rosmop", "monitors")
_ENTER, _READ = stat.S_IXOTH, stat.S_IROTH
_CLONE_NEWNS, _CLONE_NEWUSER = 0x00020000, 0x10000000
_MS_RDONLY, _MS_NOSUID, _MS_NODEV, _MS_NOEXEC, _MS_REMOUNT, _MS_REC, _MS_SLAVE = (
    1 << bit for bit in (0, 1, 2, 3, 5, 14, 19)
)  # fmt: skip
_COVER = _MS_NOSUID | _MS_NODEV | _MS_NOEXEC
_OPEN_TREE, _MOVE_MOUNT, _MOUNT_SETATTR = 428, 429, 442
_OPEN_TREE_CLONE, _MOVE_MOUNT_F_EMPTY_PATH = 1, 4
_AT_FDCWD, _AT_EMPTY_PATH, _AT_RECURSIVE = -100, 0x1000, 0x8000
_ATTR_READ_ONLY = 1 | 2 | 4  # MOUNT_ATTR_RDONLY, _NOSUID, _NODEV
_ATTR_IDMAP = 1 << 20
_REMEDY = (
    "let all users enter every folder above it and read its files (chmod -R go+rX), or use another folder, such as "
    "one in /opt"
)
_NOT_A_MOUNT = (
    "the root directory is not a mount point, as in a chroot, so no view of the program can be mounted for the users "
    "of the processes: before the chroot, run `mount --bind DIR DIR` with its directory"
)


class ViewError(Exception):
    """A view cannot be made."""


@dataclass(frozen=True)
class PrivateView:
    """A view; `owned` are the folders of the program with files that only their owner may read."""

    covered: tuple[str, ...]
    program: tuple[str, ...]
    owned: tuple[str, ...]
    state: str | None


def program_folders() -> tuple[Path, ...]:
    top, environment = Path(appliance.__file__).resolve().parent.parent, Path(sys.prefix).resolve()
    packages = () if top.is_relative_to(environment) else tuple(top / name for name in _PARTS)
    return (environment, *packages)


def view_of(program: Sequence[Path], state: Path) -> PrivateView | None:
    """Return the view that the processes need; None if other users reach everything, or the processes are not root."""
    if os.geteuid() != 0:
        return None
    owned = [folder for folder in program if not _is_open(folder)]
    closed = [folder for folder in program if folder in owned or _closed_above(folder)]
    shown = [*closed, *([state] if _closed_above(state) and state == state.resolve() else [])]
    if not shown:
        return None
    covered = {str(above) for folder in shown if (above := _closed_above(folder)) is not None}
    return PrivateView(
        covered=tuple(sorted(covered)),
        program=tuple(map(str, closed)),
        owned=tuple(map(str, owned)),
        state=str(state) if state in shown else None,
    )


def require_view(view: PrivateView | None, *, may_mount: bool) -> PrivateView | None:
    """Raise `StartError` if the program needs a view that this process may not mount."""
    if view is None or may_mount:
        return view
    if view.program:
        raise StartError(
            f"the users of the processes cannot read the program in {', '.join(view.program)}; {_REMEDY}, or give the "
            "container SYS_ADMIN, so that the appliance can mount it for them"
        )
    return None


def enter(view: PrivateView, account: Account) -> None:
    """Mount the view in this process, which has one thread, before the change of user. Raises `ViewError`."""
    try:
        _enter(view, account)
    except OSError as error:
        raise ViewError(
            f"{', '.join(view.program) or view.state} cannot be mounted for user {account.name}: {error}; {_REMEDY}"
        ) from error


def _enter(view: PrivateView, account: Account) -> None:
    libc_call("unshare(CLONE_NEWNS)", _CLONE_NEWNS)
    try:
        _mount("none", "/", None, _MS_REC | _MS_SLAVE)
    except OSError as error:
        if error.errno == errno.EINVAL:
            raise ViewError(_NOT_A_MOUNT) from error
        raise
    trees = [(folder, _tree(folder, account if folder in view.owned else None)) for folder in view.program]
    trees += [(view.state, _clone(view.state))] if view.state is not None else []
    mask = os.umask(0o022)
    for folder in view.covered:
        _mount("tmpfs", folder, b"mode=755,size=64k", _COVER)
    for folder, tree in trees:
        Path(folder).mkdir(parents=True, exist_ok=True)
        target = os.fsencode(folder)
        moved = system_call(_MOVE_MOUNT, tree, b"", _AT_FDCWD, target, _MOVE_MOUNT_F_EMPTY_PATH)
        _require(moved, f"move_mount({folder})")
        os.close(tree)
    for folder in view.covered:
        _mount("tmpfs", folder, b"mode=755,size=64k", _COVER | _MS_REMOUNT | _MS_RDONLY)
    os.umask(mask)


def _closed_above(path: Path) -> Path | None:
    return next((folder for folder in reversed(path.parents) if not _permits(folder, _ENTER)), None)


def _is_open(folder: Path) -> bool:
    """Return whether others may read the folder. All files of the program count: a pull may use another umask."""
    if folder.name not in _PARTS:
        return _permits(folder, _ENTER | _READ)
    return all(
        _permits(Path(place), _ENTER | _READ) and all(_permits(Path(place, name), _READ) for name in files)
        for place, _folders, files in os.walk(folder)
        if not place.endswith("__pycache__")
    )


def _permits(path: Path, wanted: int) -> bool:
    try:
        return path.stat().st_mode & wanted == wanted
    except FileNotFoundError:  # the state directory is not made yet; a dangling link is not read
        return True


def _tree(folder: str, account: Account | None) -> int:
    tree = _clone(folder)
    if account is None:
        _set_attributes(tree, _ATTR_READ_ONLY, 0, folder)
        return tree
    with _user_namespace(Path(folder).stat(), account) as namespace:
        _set_attributes(tree, _ATTR_READ_ONLY | _ATTR_IDMAP, namespace, folder)
    return tree


def _clone(folder: str) -> int:
    flags = _OPEN_TREE_CLONE | os.O_CLOEXEC | _AT_RECURSIVE
    return _require(system_call(_OPEN_TREE, _AT_FDCWD, os.fsencode(folder), flags), f"open_tree({folder})")


def _set_attributes(tree: int, attributes: int, namespace: int, folder: str) -> None:
    wanted = struct.pack("=QQQQ", attributes, 0, 0, namespace)
    flags = _AT_EMPTY_PATH | _AT_RECURSIVE
    _require(system_call(_MOUNT_SETATTR, tree, b"", flags, wanted, len(wanted)), f"mount_setattr({folder})")


@contextlib.contextmanager
def _user_namespace(owner: os.stat_result, account: Account) -> Iterator[int]:
    """Yield a user namespace that maps the owner to the account; only mounts use it."""
    here, there = socket.socketpair()
    child = os.fork()
    if child == 0:
        here.close()
        with contextlib.suppress(BaseException):
            libc_call("unshare(CLONE_NEWUSER)", _CLONE_NEWUSER)
            there.send(b".")
            there.recv(1)  # until the parent closes its end, or dies
        os._exit(0)
    there.close()
    try:
        if not here.recv(1):
            raise OSError("a user namespace cannot be made; check sysctl user.max_user_namespaces")
        process = Path("/proc", str(child))
        (process / "uid_map").write_text(f"{owner.st_uid} {account.uid} 1", encoding="ascii")
        (process / "gid_map").write_text(f"{owner.st_gid} {account.gid} 1", encoding="ascii")
        namespace = os.open(process / "ns" / "user", os.O_RDONLY | os.O_CLOEXEC)
    finally:
        here.close()
        os.waitpid(child, 0)
    try:
        yield namespace
    finally:
        os.close(namespace)


def _mount(source: str, target: str, options: bytes | None, flags: int) -> None:
    kind = b"tmpfs" if source == "tmpfs" else None
    libc_call(f"mount({target})", source.encode(), os.fsencode(target), kind, ctypes.c_ulong(flags), options)


def _require(outcome: tuple[int, int], what: str) -> int:
    result, number = outcome
    if result < 0:
        raise OSError(number, f"{what}: {os.strerror(number)}")
    return result
