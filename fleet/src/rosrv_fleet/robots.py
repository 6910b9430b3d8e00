"""Keep the enrolled robots in one file each, so that uploads need no database.

A file pins the exact client certificates, the keys of the audit logs' signers, and the group. A removed robot keeps
its file, because its segments are still verified.
"""

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import pwd
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import structlog

from appliance.base import clock
from appliance.base.atomic_files import write_whole
from rosrv_fleet.enrolment import (
    FIRST,
    EnrolmentError,
    Robot,
    RobotAppliance,
    RobotGroup,
    check_name,
    check_stored,
    move,
    new_appliance,
    new_robot,
    renew,
    valid_certificate,
    with_appliance,
    without_appliance,
)

# Record each change of robots, invitations, tokens and evidence with its author (docs/reference/fleet.md, Acts).
#
# No change takes effect before its record is on the disk. An act without a second line was cut off by a crash, and may
# or may not have taken effect.

FILE = "acts.ndjson"


@contextmanager
def record_act(data: Path, act: str, about: str, detail: str = "", who: str = "") -> Iterator[None]:
    """Record an act around the block that carries it out.

    `who` defaults to this command's user, or the user who called sudo. If the act cannot be recorded, raise `OSError`
    before the block runs.
    """
    fields = {"who": who or _user(), "act": act, "about": about, "detail": detail}
    _append(data, fields | {"result": "asked"})
    result = "done"
    try:
        yield
    except BaseException as error:
        result = f"failed: {str(error) or type(error).__name__}"
        raise
    finally:
        with contextlib.suppress(OSError):  # the act is recorded already
            _append(data, fields | {"result": result})


def _append(data: Path, fields: dict[str, str]) -> None:
    time = clock.utc_now().isoformat(timespec="milliseconds")
    line = json.dumps({"time": time} | fields).encode() + b"\n"
    with contextlib.ExitStack() as opened:
        folder = os.open(data, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        opened.callback(os.close, folder)
        file = os.open(FILE, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600, dir_fd=folder)
        opened.callback(os.close, file)
        fcntl.flock(file, fcntl.LOCK_EX)
        end = os.fstat(file).st_size
        if end and os.pread(file, 1, end - 1) != b"\n":  # a full disk or a crash cut the last line off
            line = b"\n" + line
        try:
            written = os.write(file, line)
            os.fsync(file)
            os.fsync(folder)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(data / FILE)) from error
        if written < len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(data / FILE))


def _user() -> str:
    try:
        own = pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        own = str(os.getuid())
    behind = os.environ.get("SUDO_USER", "")
    return f"{behind} as {own}" if behind and os.getuid() == 0 else own


_log = structlog.get_logger()


@contextmanager
def changing(folder: Path) -> Iterator[None]:
    make_folder(folder)
    descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


class Robots:
    """The robots in a folder. Thread-safe; changes by other processes are noticed.

    The methods raise `EnrolmentError` and `OSError`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lock = threading.Lock()
        self._seen = -1
        self._again = 0.0
        self._robots: dict[str, Robot] = {}
        self._connecting: dict[str, Robot] = {}
        self._since: dict[str, float] = {}
        self.unreadable: dict[str, str] = {}

    @property
    def trouble(self) -> str | None:
        return next(iter(self.unreadable.values()), None)

    def all(self) -> dict[str, Robot]:
        known = self.known()
        if self.trouble is not None:
            raise EnrolmentError(self.trouble)
        return known

    def known(self) -> dict[str, Robot]:
        """Return the robots. A robot with an unreadable file is in `unreadable`, and keeps its last valid state."""
        with self._lock:
            now = clock.wall_ns()
            changed = self.folder.stat().st_mtime_ns if self.folder.is_dir() else 0
            if changed != self._seen and clock.now() >= self._again:
                files = self.folder.iterdir() if changed else ()
                self._read(sorted(file for file in files if file.suffix == ".json"))
                # A second change within the clock's step would go unnoticed, so a folder that was fresh before the
                # reading is read again; and a repaired file does not change the folder.
                fresh = now - changed <= 1_000_000_000
                self._seen = -1 if fresh or self.unreadable else changed
                self._again = clock.now() + 1.0 if self.unreadable else 0.0
            return self._robots

    def _read(self, files: list[Path]) -> None:
        robots, unreadable = {}, {}
        for file in files:
            try:
                robots[file.stem] = _read(file, self._robots.get(file.stem))
            except EnrolmentError as error:
                unreadable[file.stem] = str(error)
                if file.stem in self._robots:
                    robots[file.stem] = self._robots[file.stem]
        for name in unreadable.keys() - self.unreadable.keys():
            _log.error("the file of a robot is unreadable", reason=unreadable[name])
        self._connecting = {
            one.fingerprint: robot for robot in robots.values() for one in robot.connecting.values()
        }
        self._since = {robot: self._since.get(robot, clock.now()) for robot in self._connecting}
        self._robots, self.unreadable = robots, unreadable

    def accepted_since(self, fingerprint: str) -> float:
        """Return when this process first accepted a certificate, in monotonic seconds."""
        return self._since.get(fingerprint, clock.now())

    def with_certificate(self, der: bytes) -> Robot | None:
        self.known()
        return self._connecting.get(hashlib.sha256(der).hexdigest())

    def groups(self) -> dict[str, RobotGroup]:
        return {
            robot.name: RobotGroup.parse(robot.group)
            for robot in self.known().values()
            if robot.group and robot.removed is None
        }

    def add(self, name: str, key: bytes, certificate: bytes, group: str = "", appliance: str = "") -> Robot:
        with changing(self.folder):
            known = self.all().get(name)
            if known is not None and appliance in ("", *known.appliances):
                raise EnrolmentError(
                    f"{name} is already enrolled; for a new certificate: rosrv-fleet robot renew {name} --certificate"
                    " FILE; for its standby: --appliance NAME"
                )
            robot, own = self._with(known, name, appliance, new_appliance(key, certificate), group)
            return self._keep(robot, "robot add", f"{group} {_detail(robot, own)}".strip())

    def renew(self, name: str, certificate: bytes, appliance: str = "") -> Robot:
        with changing(self.folder):
            known = self.require(name)
            own = appliance or (known.appliance if len(known.connecting) < 2 else "")
            if own not in known.appliances:
                raise EnrolmentError(
                    f"{name} has no appliance {own!a}: use --appliance {' or '.join(known.connecting)}"
                )
            robot = self._unique(renew(known, own, valid_certificate(certificate)))
            return self._keep(robot, "robot renew", _detail(robot, own))

    def move(self, name: str, group: str) -> Robot:
        with changing(self.folder):
            return self._keep(move(self.require(name), group), "robot group", group)

    def join(
        self,
        name: str,
        key: bytes,
        certificate: bytes,
        group: str,
        appliance: str = "",
        *,
        again: bool = False,
    ) -> Robot:
        """Enrol a robot or its second appliance, or replace the certificate of the appliance with this log key.

        Without a `group`, an enrolled robot keeps its group. With `again`, the robot repeats its request.
        """
        with changing(self.folder):
            known = self.all().get(name)
            robot, own = self._with(known, name, appliance, new_appliance(key, certificate), group)
            if again and known is not None and msgspec.structs.replace(robot, group=known.group) == known:
                return known
            return self._keep(robot, "robot join", _detail(robot, own))

    def remove(self, name: str, appliance: str = "") -> None:
        """Reject the connections of a robot, or of one of its two appliances. Its segments stay."""
        with changing(self.folder):
            known = self.require(name)
            if appliance:
                self._keep(without_appliance(known, appliance), "robot remove", f"appliance {appliance}")
            else:
                self._keep(msgspec.structs.replace(known, removed=clock.wall_ns()), "robot remove")

    def require(self, name: str) -> Robot:
        robot = self.known().get(name)
        if robot is None:
            if name in self.unreadable:
                raise EnrolmentError(self.unreadable[name])
            raise EnrolmentError(f"{name!a} is not enrolled; list the robots: rosrv-fleet robot list")
        return robot

    def _with(
        self, known: Robot | None, name: str, appliance: str, made: RobotAppliance, group: str
    ) -> tuple[Robot, str]:
        """Return the robot with the appliance, and the appliance's name.

        The log key identifies an appliance, so a known one gets the new certificate.
        """
        if appliance:
            check_name(appliance)
        if known is None:
            return self._unique(new_robot(name, made, group, appliance or FIRST)), appliance or FIRST
        own = next((one for one, found in known.appliances.items() if found.key == made.key), None)
        if own is not None:
            robot = renew(known, own, made.certificate)
        elif (appliance or FIRST) in known.appliances:
            raise EnrolmentError(
                f"{name} is enrolled with another log key, which its segments need: invite this robot under a new"
                f" name, or as the standby of {name}: rosrv-fleet robot invite {name} --appliance NAME"
            )
        else:
            robot = with_appliance(known, appliance or FIRST, made)
        return self._unique(move(robot, group) if group else robot), own or appliance or FIRST

    def _unique(self, robot: Robot) -> Robot:
        """Return the robot. Raise `EnrolmentError` if another one has its certificate or key, or is unreadable."""
        for other in self.all().values():
            if other.name == robot.name:
                continue
            for one in other.connecting.values():
                for own in robot.connecting.values():
                    if one.fingerprint == own.fingerprint:
                        raise EnrolmentError(f"{other.name} has this certificate; each robot needs its own")
                    if one.key == own.key:
                        raise EnrolmentError(f"{other.name} has this log key; each robot needs its own")
        return robot

    def _keep(self, robot: Robot, act: str, detail: str = "") -> Robot:
        with record_act(self.folder.parent, act, robot.name, detail):
            write_whole(self.folder / f"{robot.name}.json", msgspec.json.encode(robot), 0o600)
        with self._lock:
            self._seen = -1
        return robot


def _detail(robot: Robot, appliance: str) -> str:
    words = f"certificate {robot.appliances[appliance].fingerprint}"
    return f"{words} appliance {appliance}" if robot.others else words


def _read(file: Path, known: Robot | None) -> Robot:
    try:
        robot = msgspec.json.decode(file.read_bytes(), type=Robot)
        if robot == known:  # all files are read again after each change
            return robot
        if robot.name != file.stem:
            raise EnrolmentError(f"its name is {robot.name!a}")
        check_stored(robot)
    except (OSError, ValueError, EnrolmentError) as error:
        raise EnrolmentError(f"{file}: {error}; repair it, or remove it and enrol the robot again") from error
    return robot


def make_folder(folder: Path) -> None:
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    os.chmod(folder, 0o700)  # noqa: PTH101  `mkdir` obeys the umask only for the last folder
