"""Make a key and a certificate that is its own authority, for peers that trust exactly this certificate."""

import datetime
import ipaddress

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import NameOID

from appliance.base import clock
from appliance.base.shipped import earliest_now

_EARLIER = datetime.timedelta(days=1)  # the peer's clock may be behind


def make_own_certificate(name: str, days: int, address: str | None = None) -> tuple[bytes, bytes]:
    """Return a new key and its certificate (PEM); a server's has its IP address.

    Raises `ValueError` for an invalid address.
    """
    names = [x509.DNSName(name)] if address is None else [x509.IPAddress(ipaddress.ip_address(address))]
    private = ec.generate_private_key(ec.SECP256R1())
    public = private.public_key()
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = clock.utc_now()
    until = datetime.datetime.fromtimestamp(earliest_now(), datetime.UTC) + datetime.timedelta(days=days)
    usage = x509.KeyUsage(True, False, False, False, False, True, False, False, False)
    builder = x509.CertificateBuilder(
        subject,
        subject,
        public,
        x509.random_serial_number(),
        now - _EARLIER,
        until,
    )
    extensions: list[tuple[x509.ExtensionType, bool]] = [
        (x509.BasicConstraints(ca=True, path_length=0), True),
        (usage, True),
        (x509.SubjectKeyIdentifier.from_public_key(public), False),
        (x509.SubjectAlternativeName(names), False),
    ]
    for extension, critical in extensions:
        builder = builder.add_extension(extension, critical)
    certificate = builder.sign(private, hashes.SHA256()).public_bytes(Encoding.PEM)
    return private.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()), certificate


def untimely(pem: bytes, whose_clock: str) -> str:
    """Return when the certificate is valid and the time of the clock, if it is not valid now.

    Raises `ValueError` if it is not a certificate.
    """
    certificate, now = x509.load_pem_x509_certificate(pem), clock.utc_now()
    begins, ends = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if begins <= now <= ends:
        return ""
    return (
        f"the certificate is valid from {begins:%Y-%m-%d} to {ends:%Y-%m-%d}, and the clock of {whose_clock} shows"
        f" {now:%Y-%m-%d %H:%M} UTC"
    )
