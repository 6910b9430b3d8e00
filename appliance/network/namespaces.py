"""Make network namespaces, run code and programs in them, and delete them.

Each call gets its own thread, which ends in the namespace, because a return could fail. A program with
`PR_SET_PDEATHSIG` would be killed when `popen` returns, because its parent thread then ends; it needs `inside()`.
"""

import contextlib
import ctypes
import errno
import fcntl
import os
import re
import select
import signal
import subprocess
import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

from appliance.base import clock
from appliance.base.user_errors import UserError

DIRECTORY = Path("/run/netns")
_HERE = Path("/proc/thread-self/ns/net")  # the calling thread's namespace
_CLONE_NEWNET = 0x40000000
_MS_BIND, _MS_REC, _MS_SHARED, _MNT_DETACH = 0x1000, 0x4000, 0x100000, 2
_CAP_NET_ADMIN, _CAP_SYS_ADMIN = 12, 21
_END_SECONDS = 3.0  # between SIGTERM and SIGKILL
_ONLY_THERE = Path(
    "sys/net/core/netdev_max_backlog"
)  # only the machine's first network namespace has this setting
_CONTAINER_MARKS = (".dockerenv", "run/.containerenv")  # of Docker and Podman
_INITIAL_PIDS = "pid:[4026531836]"  # PROC_PID_INIT_INO: the machine's own process ids
_VALID_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")

T = TypeVar("T")


class NetworkError(UserError):
    """The network cannot be changed."""


class PrivilegeError(NetworkError):
    """This process may not change the network of this machine."""


def has_privileges() -> bool:
    return _has_capabilities(1 << _CAP_NET_ADMIN | 1 << _CAP_SYS_ADMIN)


def require_network_admin(what: str) -> None:
    """Raise `PrivilegeError` unless this process may change its own network."""
    if not _has_capabilities(1 << _CAP_NET_ADMIN):
        raise PrivilegeError(
            f"{what} needs CAP_NET_ADMIN: run it as root, give it to the container (cap_add: [NET_ADMIN]), "
            "or choose `isolation: none`"
        )


def _has_capabilities(wanted: int) -> bool:
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    match = re.search(r"^CapEff:\t([0-9a-f]{1,32}+)", status, re.MULTILINE)
    return match is not None and int(match[1], 16) & wanted == wanted


def require_privileges(what: str) -> None:
    """Raise `PrivilegeError` unless this process can make namespaces."""
    if not has_privileges():
        raise PrivilegeError(
            f"{what} needs root (CAP_SYS_ADMIN and CAP_NET_ADMIN): run it with sudo, "
            "or choose `isolation: container` in a container that has them, or `isolation: none`"
        )


class Namespace:
    """A network namespace, found by its name. After `create`, it stays usable if that name is deleted."""

    def __init__(self, name: str) -> None:
        if not _VALID_NAME.fullmatch(name):
            raise ValueError(
                f"{name!r} is not a valid name for a network namespace: letters, digits and _ . - only"
            )
        self.name = name
        self.path = self._handle = DIRECTORY / name
        self._let_go: Callable[[], object] = lambda: None

    @classmethod
    def own(cls) -> "Namespace":
        """Return the calling thread's namespace of now, wherever the threads of this process are later."""
        return _OwnNamespace()

    def __repr__(self) -> str:
        return f"Namespace({self.name!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Namespace) and other.path == self.path

    def __hash__(self) -> int:
        return hash(self.path)

    def exists(self) -> bool:
        """Return whether the namespace exists; a bare file from a crash does not count."""
        try:
            here, above = self.path.stat(), self.path.parent.stat()
        except OSError:
            return False
        return here.st_dev != above.st_dev

    def create(self) -> "Namespace":
        """Create the namespace, with only `lo`, which is down. Raises `PrivilegeError`, `NetworkError`."""
        require_privileges(f"creating the network namespace {self.name}")
        with _directory_lock():
            if self.exists():
                raise NetworkError(f"the network namespace {self.name} already exists ({self.path})")
            self.path.touch(mode=0o444)
            try:
                _in_thread(self._unshare_and_mount)
            except BaseException:
                self.path.unlink(missing_ok=True)
                raise
        self._keep(self.path)
        return self

    def _unshare_and_mount(self) -> None:
        libc = _libc()
        if libc.unshare(_CLONE_NEWNET) != 0:
            raise _os_failure("unshare", self.name)
        _mount(_HERE, self.path, _MS_BIND)

    def delete(self) -> None:
        """Delete the name; the kernel's namespace ends with its last process."""
        if self.exists():
            require_privileges(f"deleting the network namespace {self.name}")
            if _libc().umount2(os.fsencode(self.path), _MNT_DETACH) != 0:
                raise _os_failure("umount", self.name)
        self.path.unlink(missing_ok=True)
        self._handle = self.path
        self._let_go()

    def _keep(self, path: Path) -> None:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        self._handle = Path(f"/proc/self/fd/{descriptor}")
        self._let_go = weakref.finalize(self, os.close, descriptor)

    @contextlib.contextmanager
    def inside(self) -> Iterator[None]:
        """Move the calling thread into the namespace for the block, which must not await."""
        home = os.open(_HERE, os.O_RDONLY | os.O_CLOEXEC)
        try:
            self._enter()
            try:
                yield
            finally:
                if not os.path.samestat(os.fstat(home), _HERE.stat()):
                    _setns(home, "the thread's own namespace")
        finally:
            os.close(home)

    def run(self, function: Callable[[], T]) -> T:
        def inside() -> T:
            self._enter()
            return function()

        return _in_thread(inside)

    def popen(self, args: Sequence[str | os.PathLike[str]], **options: Any) -> "subprocess.Popen[Any]":
        """Start a program in the namespace; `options` are those of `subprocess.Popen`."""
        return self.run(lambda: subprocess.Popen(args, **options))

    def sysctl(self, key: str, value: str | None = None) -> str:
        """Return a setting, after writing `value` if given; `key` has slashes if an interface name has a dot."""
        path = Path("/proc/sys", *key.split("/" if "/" in key else "."))

        def access() -> str:
            if value is not None:
                path.write_text(value, encoding="ascii")
            return path.read_text(encoding="ascii").strip()

        try:
            return self.run(access)
        except OSError as error:
            raise NetworkError(f"sysctl {key} in {self.name}: {error.strerror}") from error

    def lacks_syn_cookies(self) -> bool:
        try:
            return self.sysctl("net.ipv4.tcp_syncookies") == "0"
        except NetworkError:  # the kernel was built without SYN cookies
            return True

    def processes(self) -> list[int]:
        """Return the other processes in the namespace."""
        processes: list[int] = []
        try:
            mark = self._handle.stat()
        except OSError:
            return processes
        for entry in Path("/proc").iterdir():
            if entry.name.isdecimal() and int(entry.name) != os.getpid():
                with contextlib.suppress(OSError):
                    seen = (entry / "ns/net").stat()
                    if (seen.st_dev, seen.st_ino) == (mark.st_dev, mark.st_ino):
                        processes.append(int(entry.name))
        return sorted(processes)

    def open(self) -> int:
        """Return a descriptor of the namespace, which the caller closes."""
        try:
            return os.open(self._handle, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise NetworkError(
                f"the network namespace {self.name} does not exist ({self.path}: {error.strerror})"
            ) from error

    def _enter(self) -> None:
        descriptor = self.open()
        try:
            _setns(descriptor, self.name)
        finally:
            os.close(descriptor)


class _OwnNamespace(Namespace):
    def __init__(self) -> None:
        self.name = "(own)"
        self._keep(_HERE)  # a path of the process would lead to the present namespace of its main thread
        self.path = self._handle.readlink()  # equal for the same namespace

    def exists(self) -> bool:
        return True

    def _enter(self) -> None:
        """Do nothing if the thread is there, because containers may not call setns."""
        if not os.path.samestat(_HERE.stat(), self._handle.stat()):
            super()._enter()

    def create(self) -> Namespace:
        raise NetworkError("the namespace of this process exists already")

    def delete(self) -> None:
        raise NetworkError("the namespace of this process cannot be deleted")


def namespaces(prefix: str = "") -> list[Namespace]:
    """Return the namespaces with this prefix, including names whose namespace no longer exists."""
    if not DIRECTORY.is_dir():
        return []
    names = sorted(entry.name for entry in DIRECTORY.iterdir())
    return [Namespace(name) for name in names if name.startswith(prefix) and _VALID_NAME.fullmatch(name)]


def _in_thread(function: Callable[[], T]) -> T:
    outcome: Future[T] = Future()

    def work() -> None:
        try:
            outcome.set_result(function())
        except BaseException as error:  # noqa: BLE001 - handed to the caller, which waits for it
            outcome.set_exception(error)

    thread = threading.Thread(target=work, name="namespace", daemon=True)
    thread.start()
    thread.join()
    return outcome.result()


@contextlib.contextmanager
def _directory_lock() -> Iterator[None]:
    DIRECTORY.mkdir(mode=0o755, exist_ok=True)
    lock = os.open(DIRECTORY.parent / "rosrv-netns.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not _is_mount_point(DIRECTORY):
            _mount(DIRECTORY, DIRECTORY, _MS_BIND | _MS_REC)
            _mount("none", DIRECTORY, _MS_SHARED | _MS_REC)
        yield
    finally:
        os.close(lock)


def _is_mount_point(path: Path) -> bool:
    """Return whether a file system is mounted there, even a bind mount onto itself, which `os.path.ismount` misses."""
    with Path("/proc/thread-self/mountinfo").open(encoding="utf-8", errors="replace") as lines:
        return any(line.split(" ", 5)[4] == str(path) for line in lines)


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _mount(source: str | Path, target: Path, flags: int) -> None:
    if _libc().mount(os.fsencode(source), os.fsencode(target), b"none", ctypes.c_ulong(flags), None) != 0:
        raise _os_failure("mount", str(target))


def _setns(descriptor: int, name: str) -> None:
    if _libc().setns(descriptor, _CLONE_NEWNET) != 0:
        raise _os_failure("setns", name)


def _os_failure(call: str, name: str) -> NetworkError:
    number = ctypes.get_errno()
    return NetworkError(f"network namespace {name}: {call}: {os.strerror(number)}{privilege_hint(number)}")


def privilege_hint(number: int) -> str:
    """Return advice on an error that a lack of privileges can cause, unless this process has them."""
    if number not in (errno.EPERM, errno.EACCES) or has_privileges():
        return ""
    return ": needs root (CAP_NET_ADMIN, CAP_SYS_ADMIN); run it with sudo"


def lives_on_the_machines_network(proc: Path = Path("/proc")) -> bool:
    return (proc / _ONLY_THERE).exists()


def is_contained(root: Path = Path("/")) -> bool:
    if any((root / mark).exists() for mark in _CONTAINER_MARKS):
        return True
    try:
        return str((root / "proc/self/ns/pid").readlink()) != _INITIAL_PIDS
    except OSError:
        return False


def bridges(classes: Path = Path("/sys/class/net")) -> list[str]:
    """Return the bridges: a machine that runs containers has at least one, a container none."""
    return sorted(link.name for link in classes.glob("*") if (link / "bridge").is_dir())


def end_processes(pids: Sequence[int]) -> None:
    """End processes with SIGTERM, then SIGKILL. A descriptor refers to each, so a reused id is never signalled."""
    descriptors: dict[int, int] = {}
    for pid in pids:
        with contextlib.suppress(OSError):
            descriptors[os.pidfd_open(pid)] = pid
    try:
        for number, limit in ((signal.SIGTERM, _END_SECONDS), (signal.SIGKILL, _END_SECONDS)):
            _signal_and_wait(descriptors, number, limit)
    finally:
        for descriptor in descriptors:
            os.close(descriptor)


def _signal_and_wait(descriptors: dict[int, int], number: signal.Signals, limit: float) -> None:
    poll = select.poll()
    waiting = set(descriptors)
    for descriptor in descriptors:
        try:
            signal.pidfd_send_signal(descriptor, number)
        except ProcessLookupError:
            waiting.discard(descriptor)
        else:
            poll.register(descriptor, select.POLLIN)
    deadline = clock.now() + limit
    while waiting and (left := deadline - clock.now()) > 0:
        for descriptor, _ in poll.poll(left * 1000):
            poll.unregister(descriptor)
            waiting.discard(descriptor)


def shared_network() -> str:
    """Return why the firewall of a container would affect the whole machine, or an empty string."""
    if is_contained() and (lives_on_the_machines_network() or bridges()):
        return (
            "isolation container: this container shares the machine's network (network_mode: host, hostNetwork), so "
            "the firewall would apply to the whole machine. Give it its own network, as compose.host.yaml does for a "
            "robot whose nodes run on the machine itself; or run rosrv without a container, with isolation netns"
        )
    return ""


def read_only_settings(sysctl: Path = Path("/proc/sys")) -> list[str]:
    """Return the kernel settings of the host that the isolation has to write, and cannot."""
    keys = ("net/ipv4/ip_forward", "net/ipv4/conf/default/route_localnet")
    return [key.replace("/", ".") for key in keys if not os.access(sysctl / key, os.W_OK)]
