"""Make and keep the self-signed certificate of REST.

Clients may trust exactly this certificate, so it is replaced only before it expires, or when the configuration gives
the appliance another name. The new host name of a recreated container is ignored.
"""

import base64
import datetime
import hashlib
import ipaddress
import re
import socket
import ssl
from collections.abc import Iterable
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from appliance.base.atomic_files import write_whole
from appliance.base.shipped import before_program

CERTIFICATE = "certificate.pem"
KEY = "key.pem"
_DAYS = 825
_RENEW_DAYS = 30
_TOO_EARLY = datetime.datetime(2025, 1, 1, tzinfo=datetime.UTC)  # an earlier clock is wrong
_HOST_NAME_LIMIT = 64
_CONTAINER_ID = re.compile("[0-9a-f]{12}")


def tls_context(home: Path, names: Iterable[str], now: datetime.datetime) -> ssl.SSLContext:
    """Return the server's context; make a new certificate unless a valid one with all `names` is stored.

    Raises `OSError`, `ValueError` and `ssl.SSLError`.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.set_alpn_protocols(["http/1.1"])
    _make_if_needed(home, names, now)
    context.load_cert_chain(home / CERTIFICATE, home / KEY)
    return context


def renew(context: ssl.SSLContext, home: Path, names: Iterable[str], now: datetime.datetime) -> bool:
    """Replace the certificate if needed; return whether it was. Raises as `tls_context` does."""
    made = _make_if_needed(home, names, now)
    if made:
        context.load_cert_chain(home / CERTIFICATE, home / KEY)
    return made


def _make_if_needed(home: Path, names: Iterable[str], now: datetime.datetime) -> bool:
    certificate, key = home / CERTIFICATE, home / KEY
    wanted = [*dict.fromkeys([*names, "localhost", "127.0.0.1", "::1"])]
    try:
        if certificate.exists() and key.exists() and _still_good(certificate, wanted, now):
            return False
        machine = socket.gethostname()
        _make(certificate, key, wanted if _CONTAINER_ID.fullmatch(machine) else [*wanted, machine], now)
    except ValueError as error:
        raise ValueError(
            f"{home}: {CERTIFICATE} or {KEY} is damaged: restore both from a backup, or remove them: then hosts and"
            f" clients do not know this appliance until they get the new ones ({error})"
        ) from error
    return True


def _still_good(path: Path, names: Iterable[str], now: datetime.datetime) -> bool:
    certificate = x509.load_pem_x509_certificate(path.read_bytes())
    extension = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    ends = certificate.not_valid_after_utc - datetime.timedelta(days=_RENEW_DAYS)
    in_time = now < _TOO_EARLY or certificate.not_valid_before_utc <= now < ends
    return in_time and {_general_name(name) for name in names} <= set(extension)


def _make(certificate_path: Path, key_path: Path, names: Iterable[str], now: datetime.datetime) -> None:
    key = _kept_key(key_path)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "ROSRV appliance")])
    certificate = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(days=_DAYS, seconds=before_program()))
        .add_extension(
            x509.SubjectAlternativeName([_general_name(name) for name in dict.fromkeys(names)]),
            critical=False,
        )
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .sign(key, hashes.SHA256())
    )
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    write_whole(key_path, secret, 0o600)
    write_whole(certificate_path, certificate.public_bytes(serialization.Encoding.PEM), 0o644)


def pin_of(home: Path) -> str:
    """Return the pin in the format of curl's `--pinnedpubkey`."""
    certificate = x509.load_pem_x509_certificate((home / CERTIFICATE).read_bytes())
    public = certificate.public_key().public_bytes(
        serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo
    )
    return "sha256//" + base64.b64encode(hashlib.sha256(public).digest()).decode("ascii")


def fingerprint_of(home: Path) -> str:
    """Return the certificate's SHA-256 in hexadecimal."""
    certificate = x509.load_pem_x509_certificate((home / CERTIFICATE).read_bytes())
    return certificate.fingerprint(hashes.SHA256()).hex()


def _kept_key(path: Path) -> ec.EllipticCurvePrivateKey:
    if path.exists():
        key = serialization.load_pem_private_key(path.read_bytes(), password=None)
        if isinstance(key, ec.EllipticCurvePrivateKey):
            return key
    return ec.generate_private_key(ec.SECP256R1())


def _general_name(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name[:_HOST_NAME_LIMIT])
