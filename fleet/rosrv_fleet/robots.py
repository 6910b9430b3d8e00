"""Keep the enrolled robots: one file for each, so that uploads need no database.

A robot is identified by its exact client certificate. The key of its audit log's signer is pinned here: a robot can
push only segments that this key sealed. Its group is pinned too: it gets the bundles of this group only, and counts
only there. A removed robot keeps its file, because its segments are still verified. Each change is an act (`recorded`).
"""

import fcntl
import hashlib
import os
import re
import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, Self

import msgspec
import structlog
from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import Encoding, load_pem_public_key

from appliance.base import clock
from appliance.base.atomic_files import write_whole
from appliance.bundles.terms import TermsError, role_of
from rosrv_fleet.acts import recorded

_log = structlog.get_logger()
_NAME = re.compile("[a-z0-9][a-z0-9._-]{0,62}")


class EnrolmentError(Exception):
    """A robot cannot be enrolled or changed; the message has the reason and the remedy."""


class RobotGroup(NamedTuple):
    """A robot group of a site."""

    site: str
    group: str

    def __str__(self) -> str:
        return f"{self.site}/{self.group}"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the group in `SITE/GROUP`. Raises `EnrolmentError`."""
        site, _, group = text.partition("/")
        try:
            role_of(site, group)
        except TermsError as error:
            raise EnrolmentError(f"{text[:160]!a} is not SITE/GROUP, such as site-a/arms: {error}") from error
        return cls(site, group)


class Robot(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An enrolled robot: its name, the raw public key of its log in hexadecimal, and its certificate (PEM).

    `group` is `SITE/GROUP`, or empty: it gets no bundles. `added` and `removed` are in nanoseconds since the epoch; a
    robot with `removed` may not connect.
    """

    name: str
    key: str
    certificate: str
    added: int
    group: str = ""
    removed: int | None = None

    @property
    def certificate_ends(self) -> float:
        """Return when its certificate ends, in seconds since the epoch."""
        return x509.load_pem_x509_certificate(self.certificate.encode()).not_valid_after_utc.timestamp()

    @property
    def public_key(self) -> bytes:
        """Return the raw public key that seals its log."""
        return bytes.fromhex(self.key)

    @property
    def fingerprint(self) -> str:
        """Return the SHA-256 of its certificate, in hexadecimal."""
        return hashlib.sha256(ssl.PEM_cert_to_DER_cert(self.certificate)).hexdigest()


@contextmanager
def changing(folder: Path) -> Iterator[None]:
    """Exclude other changes of a folder during a block, also those of other processes. Raises `OSError`."""
    make_folder(folder)
    descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


class Robots:
    """The robots in a folder of the data folder. Thread-safe.

    Changes by another process are noticed, and wait for one another.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._seen = -1
        self._again = 0.0
        self._robots: dict[str, Robot] = {}
        self._connecting: dict[str, Robot] = {}
        self.unreadable: dict[str, str] = {}

    @property
    def trouble(self) -> str | None:
        """Return why a robot's file is unreadable; None: all are readable."""
        return next(iter(self.unreadable.values()), None)

    def all(self) -> dict[str, Robot]:
        """Return the robots by name. Raises `EnrolmentError` for an unreadable file: for what needs every robot."""
        known = self.known()
        if self.trouble is not None:
            raise EnrolmentError(self.trouble)
        return known

    def known(self) -> dict[str, Robot]:
        """Return the robots by name, so that a damaged file of one does not stop the others. Raises `OSError`.

        A robot whose file became unreadable keeps its last valid state; `unreadable` has the reasons by name.
        """
        with self._lock:
            now = clock.wall_ns()
            changed = self._folder.stat().st_mtime_ns if self._folder.is_dir() else 0
            if changed != self._seen and clock.now() >= self._again:
                files = self._folder.iterdir() if changed else ()
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
        active = (robot for robot in robots.values() if robot.removed is None)
        self._connecting = {robot.fingerprint: robot for robot in active}
        self._robots, self.unreadable = robots, unreadable

    def with_certificate(self, der: bytes) -> Robot | None:
        """Return the robot that may connect with this certificate (DER), or None. Raises `OSError`."""
        self.known()
        return self._connecting.get(hashlib.sha256(der).hexdigest())

    def groups(self) -> dict[str, RobotGroup]:
        """Return the group of each robot that may connect and has one. Raises `OSError`."""
        return {
            robot.name: RobotGroup.parse(robot.group)
            for robot in self.known().values()
            if robot.group and robot.removed is None
        }

    def add(self, name: str, key: bytes, certificate: bytes, group: str = "") -> Robot:
        """Enrol a robot with PEM files, in a group or in none. Raises `EnrolmentError` and `OSError`."""
        with changing(self._folder):
            if name in self.all():
                raise EnrolmentError(
                    f"{name} is already enrolled; for a new certificate: rosrv-fleet robot renew {name}"
                )
            robot = self._unique(_new_robot(name, key, certificate, group))
            return self._keep(robot, "robot add", f"{group} certificate {robot.fingerprint}".strip())

    def renew(self, name: str, certificate: bytes) -> Robot:
        """Replace a robot's certificate (PEM); a removed robot may connect again. Raises `EnrolmentError`."""
        with changing(self._folder):
            robot = self._unique(_renewed(self.named(name), certificate))
            return self._keep(robot, "robot renew", f"certificate {robot.fingerprint}")

    def move(self, name: str, group: str) -> Robot:
        """Put a robot into another group. Raises `EnrolmentError` and `OSError`."""
        with changing(self._folder):
            return self._keep(_moved(self.named(name), group), "robot group", group)

    def join(self, name: str, key: bytes, certificate: bytes, group: str, *, again: bool = False) -> Robot:
        """Enrol an invited robot, or give an enrolled one with the same log key this certificate.

        Without a `group`, an enrolled robot keeps its group. `again`: the robot repeats its request; nothing changes if
        it has this certificate already. Raises `EnrolmentError` and `OSError`.
        """
        with changing(self._folder):
            known = self.all().get(name)
            if known is None:
                return self._joined(_new_robot(name, key, certificate, group))
            if known.key != _log_key(key):
                raise EnrolmentError(
                    f"{name} is enrolled with another log key, which its segments need: invite this robot under a new"
                    " name"
                )
            renewed = _renewed(known, certificate)
            if again and renewed == known:
                return known
            return self._joined(_moved(renewed, group) if group else renewed)

    def _joined(self, robot: Robot) -> Robot:
        return self._keep(self._unique(robot), "robot join", f"certificate {robot.fingerprint}")

    def remove(self, name: str) -> None:
        """Reject a robot's connections from now on; its segments stay. Raises `EnrolmentError` and `OSError`."""
        with changing(self._folder):
            self._keep(msgspec.structs.replace(self.named(name), removed=clock.wall_ns()), "robot remove")

    def named(self, name: str) -> Robot:
        """Return the robot with this name. Raises `EnrolmentError`."""
        robot = self.known().get(name)
        if robot is None:
            if name in self.unreadable:
                raise EnrolmentError(self.unreadable[name])
            raise EnrolmentError(f"{name!a} is not enrolled; list the robots: rosrv-fleet robot list")
        return robot

    def _unique(self, robot: Robot) -> Robot:
        """Return the robot. Raises `EnrolmentError` if another one has its certificate or key, or is unreadable."""
        others = (one for one in self.all().values() if one.name != robot.name and one.removed is None)
        for other in others:
            if other.fingerprint == robot.fingerprint:
                raise EnrolmentError(f"{other.name} has this certificate; each robot needs its own")
            if other.key == robot.key:
                raise EnrolmentError(f"{other.name} has this log key; each robot needs its own")
        return robot

    def _keep(self, robot: Robot, act: str, detail: str = "") -> Robot:
        with recorded(self._folder.parent, act, robot.name, detail):
            write_whole(self._folder / f"{robot.name}.json", msgspec.json.encode(robot), 0o600)
        with self._lock:
            self._seen = -1
        return robot


def _new_robot(name: str, key: bytes, certificate: bytes, group: str) -> Robot:
    check_name(name)
    return Robot(
        name=name, key=_log_key(key), certificate=_certificate(certificate), added=clock.wall_ns(),
        group=str(RobotGroup.parse(group)) if group else "",
    )  # fmt: skip


def _renewed(robot: Robot, certificate: bytes) -> Robot:
    return msgspec.structs.replace(robot, certificate=_certificate(certificate), removed=None)


def _moved(robot: Robot, group: str) -> Robot:
    return msgspec.structs.replace(robot, group=str(RobotGroup.parse(group)))


def check_name(name: str) -> None:
    """Raise `EnrolmentError` for a name that robots cannot have."""
    if _NAME.fullmatch(name) is None:
        raise EnrolmentError(
            f"{name!a}: use 1 to 63 small letters, digits, '.', '_', '-'; first a letter or digit"
        )


def _read(file: Path, known: Robot | None) -> Robot:
    """Return the robot in a file. `known` was read from it earlier. Raises `EnrolmentError`."""
    try:
        robot = msgspec.json.decode(file.read_bytes(), type=Robot)
        if robot == known:  # all files are read again after each change
            return robot
        if robot.name != file.stem:
            raise EnrolmentError(f"its name is {robot.name!a}")
        _certificate(robot.certificate.encode())
        Ed25519PublicKey.from_public_bytes(robot.public_key)
        if robot.group:
            RobotGroup.parse(robot.group)
    except (OSError, ValueError, EnrolmentError) as error:
        raise EnrolmentError(f"{file}: {error}; repair it, or remove it and enrol the robot again") from error
    return robot


def _log_key(pem: bytes) -> str:
    try:
        key = load_pem_public_key(pem)
    except (ValueError, UnsupportedAlgorithm) as error:
        raise EnrolmentError(f"--key: not a public key in PEM: {error}") from error
    if not isinstance(key, Ed25519PublicKey):
        raise EnrolmentError(
            "--key: not an Ed25519 key; it is control/audit.pub in the appliance's state directory"
        )
    return key.public_bytes_raw().hex()


def _certificate(pem: bytes) -> str:
    """Return a certificate (PEM) if all that the collector reads of it later can be read.

    A certificate is parsed only where it is read, and TLS has another parser: what passes here must fail nowhere else.
    """
    try:
        found = x509.load_pem_x509_certificate(pem)
        found.not_valid_before_utc.timestamp()
        found.not_valid_after_utc.timestamp()
        text = found.public_bytes(Encoding.PEM).decode("ascii")
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_verify_locations(cadata=text)
    except (ValueError, x509.InvalidVersion, ssl.SSLError) as error:
        raise EnrolmentError(f"--certificate: not a valid certificate in PEM: {error}") from error
    return text


def require_own_signature(pem: bytes) -> None:
    """Require that a certificate (PEM) is signed with its own key, so that its sender has the key.

    Raises `EnrolmentError`.
    """
    certificate = x509.load_pem_x509_certificate(_certificate(pem).encode())
    try:
        certificate.verify_directly_issued_by(certificate)
    except (ValueError, TypeError, InvalidSignature, UnsupportedAlgorithm, x509.InvalidVersion):
        raise EnrolmentError("the certificate is not signed with its own key") from None


def make_folder(folder: Path) -> None:
    """Create a folder that only its owner may enter."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    os.chmod(folder, 0o700)  # noqa: PTH101  `mkdir` obeys the umask only for the last folder
