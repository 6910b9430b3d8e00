"""Prepare the state directory: set owners and modes of its parts, and lock it for one appliance.

A foreign directory is refused, because `--state /tmp` would close /tmp to all users.

state/            0711  root: others may pass through, not list
state/lock        0600  locked while an appliance runs
state/admin.sock  0600  for the other verbs of `rosrv`
state/monitors/   0700  root: the state of monitors (`monitor_memory.py`)
state/run/        0755  the resolved configuration for the children
state/relay/      0700  rosrv-relay    and so on, one folder per role, for its user only
state/control/    2710  rosrv:rosrv-api  (as root) new files get this group, which may read the audit log
"""

import contextlib
import errno
import fcntl
import os
import socket
import sqlite3
import stat
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

from appliance.base.atomic_files import remove_unfinished, write_whole
from appliance.base.owner_access import acting_as_owner
from appliance.features.table import members
from appliance.store.writer_thread import StoreError, require_0_4
from appliance.supervisor.errors import StartError
from appliance.supervisor.role import Role
from appliance.supervisor.users import account_of

ADMIN_SOCKET = "admin.sock"
_LOCK = "lock"
STORED = Path("control", "state.db")  # identifies a restored backup, which has no lock file
_OF_THE_DISK = "lost+found"
_SHOWN = 3


def foreign(path: Path) -> str | None:
    """Return why the directory is not an appliance's state; None if it is, or is empty or missing. Raises `OSError`."""
    if not path.is_dir():
        return None
    found = sorted(entry.name for entry in path.iterdir() if entry.name != _OF_THE_DISK)
    prepared = any(
        (path / name).is_file() for names in members("state_files", "STATE_FILES") for name in names
    )
    if not found or _has_lock(path) or (path / STORED).is_file() or prepared:
        return None
    more = " …" if len(found) > _SHOWN else ""
    return f"{path} is not the state directory of an appliance: it contains {', '.join(found[:_SHOWN])}{more}"


def _has_lock(path: Path) -> bool:
    """Return whether its owner has created a lock file: in a shared folder, any user may create one."""
    try:
        lock = (path / _LOCK).lstat()
    except FileNotFoundError:
        return False
    return stat.S_ISREG(lock.st_mode) and lock.st_uid in {os.geteuid(), path.stat().st_uid}


def made_before_0_4(path: Path) -> str | None:
    """Return why this version cannot continue a state; None if it can, or none is stored. Raises `OSError`."""
    try:
        with read_only(path) as database:
            if database is not None:
                require_0_4(database.execute)
    except sqlite3.Error as error:
        raise OSError(f"{path / STORED}: {error}") from error
    except StoreError as error:
        return f"{path}: {error}"
    return None


@contextlib.contextmanager
def read_only(path: Path) -> Iterator[sqlite3.Connection | None]:
    """Open what is stored in a state directory. If an appliance closed it, SQLite writes nothing there either."""
    file = path.absolute() / STORED
    log = file.with_name(f"{file.name}-wal")
    with acting_as_owner(file.parent):
        if not file.exists():
            yield None
            return
        still = "" if log.exists() and log.stat().st_size else "&immutable=1"
        with contextlib.closing(sqlite3.connect(f"{file.as_uri()}?mode=ro{still}", uri=True)) as database:
            yield database


class StateDirectory:
    """The directory, whose lock is held until `close`."""

    def __init__(self, path: Path) -> None:
        """Lock the directory. Raises `StartError`."""
        self.path = path.absolute()
        self._written: list[str] = []  # for the children, beside the configuration
        try:
            if (reason := foreign(self.path)) is not None:
                raise StartError(f"{reason}; name another directory, empty or new, with --state DIR")
            self.path.mkdir(mode=0o711, parents=True, exist_ok=True)
            self.path.chmod(0o711)
            flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
            self._lock = os.open(self.path / _LOCK, flags, 0o600)
        except OSError as error:
            raise StartError(
                f"state directory {self.path} cannot be used: {error.strerror}; name another with --state DIR"
            ) from error
        self._take_lock()

    @property
    def config(self) -> Path:
        return self.path / "run" / "config.json"

    def prepare(self, roles: Collection[Role]) -> None:
        """Give the roles their parts, and remove the unfinished files of killed writers. Raises `StartError`."""
        try:
            self._give_parts(roles)
        except PermissionError as error:
            raise StartError(
                f"the parts of the state directory {self.path} cannot be given to the users of the processes: {error}; "
                "a container needs CAP_CHOWN for that (cap_add in compose.yaml)"
            ) from error
        # The lock is held and no process runs, so no process writes to these folders.
        place, mine = os.open(self.path, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC), os.geteuid()
        for user, part in {(mine, "run"), *((account_of(role.user).uid, role.part) for role in roles)}:
            with contextlib.suppress(
                PermissionError
            ):  # without CAP_SETUID no process starts, which is reported
                os.seteuid(user)  # in a container, root may not read the folders of other users
                remove_unfinished(part, place)
                os.seteuid(mine)
        os.close(place)

    def _give_parts(self, roles: Collection[Role]) -> None:
        self._folder("run", os.geteuid(), os.getegid(), 0o755)
        for role in roles:
            account = account_of(role.user)
            if role.readable_by is None or os.geteuid() != 0:
                self._folder(role.part, account.uid, account.gid, 0o700)
            else:
                self._folder(role.part, account.uid, account_of(role.readable_by).gid, 0o2710)

    def write_config(self, text: str) -> None:
        write_whole(self.config, text.encode(), 0o644)

    def write_files(self, files: Iterable[tuple[str, str, bytes]]) -> None:
        for path in self.config.parent.iterdir():
            if path != self.config and not path.is_dir():
                path.unlink()
        for name, user, contents in files:
            account = account_of(user)
            owner = (account.uid, account.gid) if os.geteuid() == 0 else None
            write_whole(self.config.with_name(name), contents, 0o600, owner)
            self._written.append(name)

    def open_admin_socket(self) -> socket.socket:
        path = self.path / ADMIN_SOCKET
        path.unlink(missing_ok=True)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        mask = os.umask(0o177)
        try:
            listener.bind(str(path))
        except OSError as error:
            listener.close()
            full = error.errno in {errno.ENOSPC, errno.EDQUOT}
            advice = "free some space" if full else "name a shorter path with --state DIR"
            raise StartError(f"{path} cannot be created: {error.strerror or error}; {advice}") from error
        finally:
            os.umask(mask)
        listener.listen(64)
        return listener

    def close(self) -> None:
        (self.path / ADMIN_SOCKET).unlink(missing_ok=True)
        for name in (self.config.name, *self._written):
            self.config.with_name(name).unlink(missing_ok=True)
        os.ftruncate(self._lock, 0)
        os.close(self._lock)
        self._lock = -1

    def _take_lock(self) -> None:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            owner = os.pread(self._lock, 20, 0).decode("ascii", "replace").strip() or "unknown"
            os.close(self._lock)
            self._lock = -1
            raise StartError(
                f"another appliance (process {owner}) already uses the state directory {self.path}: "
                f"stop it, or name another directory with --state DIR"
            ) from error
        with contextlib.suppress(OSError):  # of a full disk: the number only informs
            os.ftruncate(self._lock, 0)
            os.pwrite(self._lock, f"{os.getpid()}\n".encode(), 0)

    def _folder(self, name: str, uid: int, gid: int, mode: int) -> None:
        path = self.path / name
        try:
            path.mkdir(mode=0o700)
            _hand_over(path, uid, gid, mode)
        except FileExistsError:
            found = path.lstat()
            # This user still owns the folder if an earlier start was killed before it changed the owner.
            if not stat.S_ISDIR(found.st_mode) or found.st_uid not in (uid, os.geteuid()):
                raise StartError(
                    f"{path} is not a folder of user id {uid} (another user ran an appliance here): "
                    f"run it as that user, `chown -R {uid}:{gid} {path}`, or name another --state DIR"
                ) from None
            if (stat.S_IMODE(found.st_mode), found.st_uid, found.st_gid) != (mode, uid, gid):
                _hand_over(path, uid, gid, mode)


def _hand_over(path: Path, uid: int, gid: int, mode: int) -> None:
    """Change owner and mode as the folder's owner; otherwise the kernel drops the set-group-id bit."""
    os.chown(path, os.geteuid(), os.getegid())
    path.chmod(mode)
    os.chown(path, uid, gid)
