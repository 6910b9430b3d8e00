"""Keep the enrolled robots: one file for each, so that uploads need no database.

A robot is identified by its exact client certificate. The key of its audit log's signer is pinned here: a robot can
push only segments that this key sealed. A removed robot keeps its file, because its segments are still verified.
"""

import hashlib
import os
import re
import ssl
import threading
import time
from pathlib import Path

import msgspec
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import Encoding, load_pem_public_key

from appliance.base.atomic_files import write_whole

_NAME = re.compile("[a-z0-9][a-z0-9._-]{0,62}")


class EnrolmentError(Exception):
    """A robot cannot be enrolled or changed; the message has the reason and the remedy."""


class Robot(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An enrolled robot: its name, the raw public key of its log in hexadecimal, and its certificate (PEM).

    `added` and `removed` are in nanoseconds since the epoch; a robot with `removed` may not connect.
    """

    name: str
    key: str
    certificate: str
    added: int
    removed: int | None = None

    @property
    def public_key(self) -> bytes:
        """Return the raw public key that seals its log."""
        return bytes.fromhex(self.key)

    @property
    def fingerprint(self) -> str:
        """Return the SHA-256 of its certificate, in hexadecimal."""
        return hashlib.sha256(ssl.PEM_cert_to_DER_cert(self.certificate)).hexdigest()


class Robots:
    """The robots in a folder. Thread-safe; changes by another process are noticed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._seen = -1
        self._robots: dict[str, Robot] = {}
        self._connecting: dict[str, Robot] = {}

    def all(self) -> dict[str, Robot]:
        """Return the robots by name. Raises `EnrolmentError` for an unreadable file."""
        with self._lock:
            changed = self._folder.stat().st_mtime_ns if self._folder.is_dir() else 0
            if changed != self._seen:
                self._robots = dict(map(_read, sorted(self._folder.glob("*.json"))))
                active = (robot for robot in self._robots.values() if robot.removed is None)
                self._connecting = {robot.fingerprint: robot for robot in active}
                # A second change within the clock's step would go unnoticed, so a fresh folder is read again.
                self._seen = changed if time.time_ns() - changed > 1_000_000_000 else -1
            return self._robots

    def with_certificate(self, der: bytes) -> Robot | None:
        """Return the robot that may connect with this certificate (DER), or None."""
        self.all()
        return self._connecting.get(hashlib.sha256(der).hexdigest())

    def add(self, name: str, key: bytes, certificate: bytes) -> Robot:
        """Enrol a robot with PEM files. Raises `EnrolmentError` and `OSError`."""
        if _NAME.fullmatch(name) is None:
            raise EnrolmentError(
                f"{name!a}: use 1 to 63 small letters, digits, '.', '_', '-'; first a letter or digit"
            )
        if name in self.all():
            raise EnrolmentError(
                f"{name} is already enrolled; for a new certificate: rosrv-fleet robot renew {name}"
            )
        robot = Robot(
            name=name, key=_log_key(key), certificate=_certificate(certificate), added=time.time_ns()
        )
        self._keep(robot)
        return robot

    def renew(self, name: str, certificate: bytes) -> Robot:
        """Replace a robot's certificate (PEM); a removed robot may connect again. Raises `EnrolmentError`."""
        robot = msgspec.structs.replace(self.named(name), certificate=_certificate(certificate), removed=None)
        self._keep(robot)
        return robot

    def remove(self, name: str) -> None:
        """Let a robot connect no more; its segments stay. Raises `EnrolmentError` and `OSError`."""
        self._keep(msgspec.structs.replace(self.named(name), removed=time.time_ns()))

    def named(self, name: str) -> Robot:
        """Return the robot with this name. Raises `EnrolmentError`."""
        robot = self.all().get(name)
        if robot is None:
            raise EnrolmentError(f"{name!a} is not enrolled; list the robots: rosrv-fleet robot list")
        return robot

    def _keep(self, robot: Robot) -> None:
        others = (one for one in self.all().values() if one.name != robot.name and one.removed is None)
        for other in others:
            if other.fingerprint == robot.fingerprint:
                raise EnrolmentError(f"{other.name} has this certificate; each robot needs its own")
            if other.key == robot.key:
                raise EnrolmentError(f"{other.name} has this log key; each robot needs its own")
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_whole(self._folder / f"{robot.name}.json", msgspec.json.encode(robot), 0o600)
        with self._lock:
            self._seen = -1


def _read(file: Path) -> tuple[str, Robot]:
    try:
        robot = msgspec.json.decode(file.read_bytes(), type=Robot)
    except (OSError, msgspec.MsgspecError) as error:
        raise EnrolmentError(f"{file}: {error}; repair it, or remove it and enrol the robot again") from error
    return robot.name, robot


def _log_key(pem: bytes) -> str:
    try:
        key = load_pem_public_key(pem)
    except ValueError as error:
        raise EnrolmentError(f"--key: not a public key in PEM: {error}") from error
    if not isinstance(key, Ed25519PublicKey):
        raise EnrolmentError(
            "--key: not an Ed25519 key; it is control/audit.pub in the appliance's state directory"
        )
    return key.public_bytes_raw().hex()


def _certificate(pem: bytes) -> str:
    try:
        return x509.load_pem_x509_certificate(pem).public_bytes(Encoding.PEM).decode("ascii")
    except ValueError as error:
        raise EnrolmentError(f"--certificate: not a certificate in PEM: {error}") from error


def make_folder(folder: Path) -> None:
    """Create a folder that only its owner may enter."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    os.chmod(folder, 0o700)  # noqa: PTH101  `mkdir` obeys the umask only for the last folder
