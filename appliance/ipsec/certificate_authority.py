"""Run the certificate authority of an appliance: issue certificates of hosts, and sign the revocation list.

1. The key never leaves the process. A key without its certificate, a certificate of another key, or a key that others
   may read is an error; nothing is replaced.
2. Only the public key of a request is used: this module sets the names, times and usages of a certificate.
3. A certificate is never valid for longer than the authority's own. Its time counts from the date of the program's
   files if the clock is behind them. The certificates of the authority and of the appliance begin at that date, so a
   clock that was ahead shuts no host out; a host's begins when it is made, because hosts renew by its length.
4. charon ignores a revocation list with a lower number, so its number always grows, even if the clock is set back.
"""

import contextlib
import datetime
import re
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from appliance.base import clock
from appliance.base.atomic_files import write_whole
from appliance.base.shipped import certainly_past, earliest_now
from appliance.channel.messages import APPLIANCE_NAME
from appliance.ipsec.authority_key import Kind, SignerKeyError, load_key, make_key, write_key

# Verify that the holder of an earlier certificate made a signing request. No I/O.

LONGEST_PROOF = 1024  # bytes


class RequestRefusedError(Exception):
    """A request is refused, so no certificate is issued."""


def require_proof(
    request: bytes,
    proof: bytes,
    former: bytes,
    *,
    name: str,
    authority: x509.Certificate,
    now: datetime.datetime,
) -> None:
    """Raise `RequestRefusedError` unless the key of `former` signed the request.

    `former` (PEM) must be a valid certificate of the authority in this name.
    """
    try:
        certificate = x509.load_pem_x509_certificate(former)
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature) as error:
        raise RequestRefusedError(
            "the current certificate is not from this authority: create a new kit (rosrv host kit)"
        ) from error
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    if [attribute.value for attribute in names] != [name]:
        raise RequestRefusedError(
            "the current certificate has a different name: create a new kit (rosrv host kit)"
        )
    if certificate.not_valid_after_utc <= now:
        raise RequestRefusedError("the current certificate has expired: create a new kit (rosrv host kit)")
    key = certificate.public_key()
    try:
        if len(proof) > LONGEST_PROOF:
            raise InvalidSignature
        if isinstance(key, ed25519.Ed25519PublicKey):
            key.verify(proof, request)
        elif isinstance(key, ec.EllipticCurvePublicKey):
            key.verify(proof, request, ec.ECDSA(hashes.SHA384()))
        else:
            raise InvalidSignature
    except InvalidSignature as error:
        raise RequestRefusedError(
            "the request is not signed by the key of the current certificate"
        ) from error


KEY_FILE = "ca.key"
CERTIFICATE_FILE = "ca.pem"
LIST_FILE = "ca.list"  # contains the number of the last revocation list, in decimal
LONGEST_DAYS = 398
AUTHORITY_DAYS = 3650
REVOCATIONS_DAYS = 30
LONGEST_REQUEST = 16 << 10  # bytes

_NAME = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]{0,61}[A-Za-z0-9])?")
_SERIAL_BITS = 70  # random bits; with the permitted 160 bits, the revocation list would be a third longer
_CLOCKS_DIFFER = datetime.timedelta(hours=1)


@dataclass(frozen=True)
class IssuedCertificate:
    """A certificate (PEM); `serial` is in hexadecimal, the end in seconds since the epoch."""

    certificate: bytes
    serial: str
    expires: float


class CertificateAuthority:
    """The authority in a folder, made with a key of this kind if missing. Raises `SignerKeyError`, `OSError`."""

    def __init__(self, directory: Path, kind: Kind = "ecdsa", passphrase: bytes | None = None) -> None:
        key_path, certificate_path = directory / KEY_FILE, directory / CERTIFICATE_FILE
        if not key_path.exists() and not certificate_path.exists():
            _create(key_path, certificate_path, kind, passphrase)
        self._key = load_key(key_path, CERTIFICATE_FILE, kind, passphrase)
        self._hash = None if isinstance(self._key, ed25519.Ed25519PrivateKey) else hashes.SHA384()
        self._certificate = _load_certificate(certificate_path)
        if self._certificate.public_key() != self._key.public_key():
            raise SignerKeyError(
                f"{certificate_path} is not the certificate of {key_path}: restore both from one backup"
            )
        self._list_path = directory / LIST_FILE
        self._list_number = 0
        if self._list_path.exists():
            text = self._list_path.read_bytes()
            if not text.isdigit():
                raise SignerKeyError(
                    f"{self._list_path} is damaged: it has no number: restore it from a backup"
                )
            self._list_number = int(text)

    @property
    def certificate(self) -> bytes:
        return self._certificate.public_bytes(Encoding.PEM)

    def issue(
        self, request: bytes, name: str, days: float, *, proof: bytes = b"", former: bytes = b""
    ) -> IssuedCertificate:
        """Issue a certificate. Raises `RequestRefusedError`.

        `proof`, if given, is the signature over the request by the key of `former` (PEM).
        """
        if not _NAME.fullmatch(name):
            raise RequestRefusedError(
                f"{name[:80]!r} is not a valid name for a certificate: letters, digits and . _ -, at most 63"
            )
        if not 0 < days <= LONGEST_DAYS:
            raise RequestRefusedError(f"a certificate is valid for at most {LONGEST_DAYS} days")
        public_key = _key_of(request)
        now = clock.utc_now()
        if proof or former:
            require_proof(request, proof, former, name=name, authority=self._certificate, now=now)
        end = min(_end_after(days), self._certificate.not_valid_after_utc)
        certificate = (
            x509.CertificateBuilder()
            .subject_name(_subject(name))
            .issuer_name(self._certificate.subject)
            .public_key(public_key)
            .serial_number(secrets.randbits(_SERIAL_BITS) | 1 << _SERIAL_BITS)
            .not_valid_before((_past() if name == APPLIANCE_NAME else now) - _CLOCKS_DIFFER)
            .not_valid_after(end)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(authority=False), critical=True)
            .add_extension(
                x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]),
                critical=False,
            )
            .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(public_key), critical=False)
            .add_extension(self._identifier(), critical=False)
            .sign(self._key, self._hash)
        )
        return IssuedCertificate(
            certificate.public_bytes(Encoding.PEM),
            f"{certificate.serial_number:x}",
            certificate.not_valid_after_utc.timestamp(),
        )

    def revocations(self, serials: Iterable[tuple[str, float]]) -> bytes:
        """Return a signed revocation list (PEM); serial numbers are hexadecimal, times seconds since the epoch."""
        now = clock.utc_now()
        builder = (
            x509.CertificateRevocationListBuilder()
            .issuer_name(self._certificate.subject)
            .last_update(now - _CLOCKS_DIFFER)
            .next_update(_end_after(REVOCATIONS_DAYS))
            .add_extension(x509.CRLNumber(self._next_list()), critical=False)
            .add_extension(self._identifier(), critical=False)
        )
        for serial, moment in serials:
            builder = builder.add_revoked_certificate(
                x509.RevokedCertificateBuilder()
                .serial_number(int(serial, 16))
                .revocation_date(datetime.datetime.fromtimestamp(moment, datetime.UTC))
                .build()
            )
        return builder.sign(self._key, self._hash).public_bytes(Encoding.PEM)

    def _next_list(self) -> int:
        self._list_number = max(self._list_number + 1, clock.wall_ns())
        # A full disk must not prevent a revocation; this process remembers the number.
        with contextlib.suppress(OSError):
            write_whole(self._list_path, b"%d" % self._list_number, 0o600)
        return self._list_number

    def _identifier(self) -> x509.AuthorityKeyIdentifier:
        return x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key())


def _key_of(request: bytes) -> ec.EllipticCurvePublicKey | ed25519.Ed25519PublicKey:
    """Return the key of a request. Raises `RequestRefusedError` unless its own private key signed it."""
    if len(request) > LONGEST_REQUEST:
        raise RequestRefusedError(f"the signing request is longer than {LONGEST_REQUEST} bytes")
    try:
        parsed = x509.load_pem_x509_csr(request)
        key, signed = parsed.public_key(), parsed.is_signature_valid
    except (ValueError, TypeError, UnsupportedAlgorithm, InvalidSignature, x509.InvalidVersion) as error:
        raise RequestRefusedError(f"not a signing request (PKCS #10) in PEM: {error}") from error
    if not signed:
        raise RequestRefusedError("the signing request is not signed by its own key: make it again")
    if isinstance(key, ed25519.Ed25519PublicKey):
        return key
    if isinstance(key, ec.EllipticCurvePublicKey) and isinstance(key.curve, ec.SECP384R1):
        return key
    raise RequestRefusedError(
        "the key of the signing request is neither ECDSA on P-384 nor Ed25519; make one with "
        "`openssl ecparam -name secp384r1 -genkey -noout`"
    )


def _create(key_path: Path, certificate_path: Path, kind: Kind, passphrase: bytes | None) -> None:
    key = make_key(kind)
    serial = x509.random_serial_number()
    subject = _subject(f"ROSRV appliance authority {serial % 0x1000000:06x}")
    certificate = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(serial)
        .not_valid_before(_past() - _CLOCKS_DIFFER)
        .not_valid_after(_end_after(AUTHORITY_DAYS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(authority=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA384() if kind == "ecdsa" else None)
    )
    # Write the certificate first: after a crash in between, the error for a certificate without its key has a remedy.
    write_whole(certificate_path, certificate.public_bytes(Encoding.PEM), 0o644)
    write_key(key_path, key, passphrase)


def _end_after(days: float) -> datetime.datetime:
    return datetime.datetime.fromtimestamp(earliest_now(), datetime.UTC) + datetime.timedelta(days=days)


def _past() -> datetime.datetime:
    return datetime.datetime.fromtimestamp(certainly_past(), datetime.UTC)


def _load_certificate(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except FileNotFoundError:
        raise SignerKeyError(
            f"{path}: missing, but its key is there; restore it from a backup, or remove {KEY_FILE} to begin"
            " with a new authority (every host enrols again)"
        ) from None
    except ValueError as error:
        raise SignerKeyError(
            f"{path}: not a certificate in PEM: {error}; restore it from a backup"
        ) from error


def _subject(name: str) -> x509.Name:
    return x509.Name(
        [
            x509.NameAttribute(NameOID.ORGANIZATION_NAME, "ROSRV"),
            x509.NameAttribute(NameOID.COMMON_NAME, name),
        ]
    )


def _usage(*, authority: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=authority,
        crl_sign=authority,
        encipher_only=False,
        decipher_only=False,
    )
