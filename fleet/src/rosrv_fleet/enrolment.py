"""Define enrolled robots, and check their names, groups, keys and certificates."""

import hashlib
import re
import ssl
from typing import NamedTuple, Self

import msgspec
from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import Encoding, load_pem_public_key

from appliance.base import clock
from appliance.formats.terms import TermsError, role_of
from appliance.signing.own_certificate import untimely

FIRST = "a"
"""The default name of a robot's first appliance."""
_MAX_APPLIANCES = 2  # that may connect
_MAX_KNOWN = 100  # with those that were removed
_NAME = re.compile("[a-z0-9][a-z0-9._-]{0,62}")


class EnrolmentError(Exception):
    """A robot cannot be enrolled or changed."""


class RobotGroup(NamedTuple):
    """A robot group of a site."""

    site: str
    group: str

    def __str__(self) -> str:
        return f"{self.site}/{self.group}"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse `SITE/GROUP`. Raises `EnrolmentError`."""
        site, _, group = text.partition("/")
        try:
            role_of(site, group)
        except TermsError as error:
            raise EnrolmentError(f"{text[:160]!a} is not SITE/GROUP, such as site-a/arms: {error}") from error
        return cls(site, group)


class RobotAppliance(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An appliance of a robot: the raw public key of its log in hexadecimal, and its certificate (PEM).

    An appliance with `removed` (nanoseconds since the epoch) must not connect.
    """

    key: str
    certificate: str
    added: int
    removed: int | None = None

    @property
    def certificate_ends(self) -> float:
        return x509.load_pem_x509_certificate(self.certificate.encode()).not_valid_after_utc.timestamp()

    @property
    def public_key(self) -> bytes:
        return bytes.fromhex(self.key)

    @property
    def fingerprint(self) -> str:
        return hashlib.sha256(ssl.PEM_cert_to_DER_cert(self.certificate)).hexdigest()


class Robot(RobotAppliance, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An enrolled robot. Its inherited fields describe its first `appliance`; `others` has the rest by name.

    Removed appliances stay in `others`, because their segments are still verified. Those that were removed at
    `withdrawn`, with the whole robot, may join again. A robot without a `group` (`SITE/GROUP`) gets no bundles.
    """

    name: str
    group: str = ""
    appliance: str = FIRST
    others: dict[str, RobotAppliance] = {}
    withdrawn: int | msgspec.UnsetType = msgspec.UNSET

    @property
    def appliances(self) -> dict[str, RobotAppliance]:
        return {self.appliance: self, **self.others}

    @property
    def connecting(self) -> dict[str, RobotAppliance]:
        if self.removed is not None:
            return {}
        return {name: appliance for name, appliance in self.appliances.items() if appliance.removed is None}

    @property
    def public_keys(self) -> frozenset[bytes]:
        return frozenset(appliance.public_key for appliance in self.appliances.values())

    def appliance_with(self, der: bytes) -> str:
        fingerprint = hashlib.sha256(der).hexdigest()
        return next((name for name, one in self.connecting.items() if one.fingerprint == fingerprint), "")


def new_appliance(key: bytes, certificate: bytes) -> RobotAppliance:
    return RobotAppliance(
        key=_log_key(key), certificate=valid_certificate(certificate), added=clock.wall_ns()
    )


def valid_certificate(pem: bytes) -> str:
    """Return the certificate as normalised PEM, or raise `EnrolmentError` if it is invalid now."""
    text = _certificate(pem)
    fault = untimely(text.encode(), "the collector")
    if fault:
        raise EnrolmentError(f"{fault}: correct the clock that is wrong, and try again")
    return text


def new_robot(name: str, made: RobotAppliance, group: str, appliance: str) -> Robot:
    check_name(name)
    return Robot(
        name=name, key=made.key, certificate=made.certificate, added=made.added, appliance=appliance,
        group=str(RobotGroup.parse(group)) if group else "",
    )  # fmt: skip


def with_appliance(robot: Robot, appliance: str, made: RobotAppliance) -> Robot:
    """Return the robot with another appliance; if it was removed, only this one may connect."""
    if len(robot.connecting) >= _MAX_APPLIANCES or len({*robot.appliances, appliance}) > _MAX_KNOWN:
        raise EnrolmentError(
            f"{robot.name} has the appliances {', '.join(robot.connecting)}; remove one first:"
            f" rosrv-fleet robot remove {robot.name} --appliance NAME"
        )
    if robot.removed is None:
        return msgspec.structs.replace(robot, others=robot.others | {appliance: made})
    others = {
        name: RobotAppliance(
            key=one.key,
            certificate=one.certificate,
            added=one.added,
            removed=robot.removed if one.removed in (None, robot.withdrawn) else one.removed,
        )
        for name, one in robot.appliances.items()
        if name != appliance
    }
    return msgspec.structs.replace(
        robot, appliance=appliance, key=made.key, certificate=made.certificate, added=made.added, removed=None,
        others=others, withdrawn=robot.removed,
    )  # fmt: skip


def renew(robot: Robot, appliance: str, certificate: str) -> Robot:
    """Return the robot with a new certificate of an appliance, which may connect again if the robot was removed."""
    before = robot.appliances[appliance]
    if before.removed not in (None, robot.removed, robot.withdrawn):
        raise EnrolmentError(
            f"appliance {appliance} of {robot.name} was removed; an appliance with this log key cannot join again"
        )
    if appliance == robot.appliance and robot.removed is None:
        return msgspec.structs.replace(robot, certificate=certificate)
    changed = RobotAppliance(key=before.key, certificate=certificate, added=before.added)
    if appliance in robot.connecting:
        return msgspec.structs.replace(robot, others=robot.others | {appliance: changed})
    return with_appliance(robot, appliance, changed)


def without_appliance(robot: Robot, appliance: str) -> Robot:
    left = {name: one for name, one in robot.connecting.items() if name != appliance}
    if len(left) != 1 or len(robot.connecting) != _MAX_APPLIANCES:
        raise EnrolmentError(
            f"{appliance!a} is not one of two appliances of {robot.name}; it has: {', '.join(robot.connecting)}"
        )
    gone = robot.appliances[appliance]
    ended = RobotAppliance(
        key=gone.key, certificate=gone.certificate, added=gone.added, removed=clock.wall_ns()
    )
    ((name, stays),) = left.items()
    others = {other: one for other, one in robot.others.items() if other != name} | {appliance: ended}
    return msgspec.structs.replace(
        robot, appliance=name, key=stays.key, certificate=stays.certificate, added=stays.added, others=others
    )


def move(robot: Robot, group: str) -> Robot:
    return msgspec.structs.replace(robot, group=str(RobotGroup.parse(group)))


def check_name(name: str) -> None:
    """Raise `EnrolmentError` for a name that robots and appliances cannot have."""
    if _NAME.fullmatch(name) is None:
        raise EnrolmentError(
            f"{name!a}: use 1 to 63 of a-z, 0-9, '.', '_' and '-'; begin with a letter or digit"
        )


def check_stored(robot: Robot) -> None:
    """Raise `EnrolmentError` or `ValueError` for a robot that cannot have been stored by a command."""
    for appliance in robot.appliances.values():
        _certificate(appliance.certificate.encode())
        Ed25519PublicKey.from_public_bytes(appliance.public_key)
    for name in robot.appliances:
        check_name(name)
    if robot.group:
        RobotGroup.parse(robot.group)


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
    """Return a certificate as normalised PEM, or raise `EnrolmentError`.

    Later code reads its dates, and TLS parses it with another parser. All of this is tried here, so that a stored
    certificate fails nowhere else.
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
    """Raise `EnrolmentError` unless the certificate is self-signed, which proves that its sender has the key."""
    certificate = x509.load_pem_x509_certificate(_certificate(pem).encode())
    try:
        certificate.verify_directly_issued_by(certificate)
    except (ValueError, TypeError, InvalidSignature, UnsupportedAlgorithm, x509.InvalidVersion):
        raise EnrolmentError("the certificate is not signed with its own key") from None
