"""Make and check the certificates of the link between two appliances: TLS 1.3, each side knows the other's exactly.

No authority signs them, so neither the key of the tunnels' authority nor the time of day matters here. A certificate is
valid until the operators replace it.
"""

import datetime
import ssl
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from appliance.base.atomic_files import write_whole
from appliance.standby.membership import Membership

CERTIFICATE = "standby.pem"
KEY = "standby-key.pem"
_BEGIN = datetime.datetime(2000, 1, 1, tzinfo=datetime.UTC)  # earlier than any clock that was never set
_END = datetime.datetime(9999, 12, 31, 23, 59, 59, tzinfo=datetime.UTC)  # RFC 5280: no expiry


def make_link_certificate(home: Path) -> str:
    """Make this appliance's key and certificate in `home`, unless both exist; return the certificate (PEM).

    Raises `OSError`.
    """
    certificate_path, key_path = home / CERTIFICATE, home / KEY
    if not (certificate_path.exists() and key_path.exists()):
        key = ec.generate_private_key(ec.SECP256R1())
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "ROSRV standby link")])
        certificate = (
            x509.CertificateBuilder()
            .subject_name(name)
            .issuer_name(name)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(_BEGIN)
            .not_valid_after(_END)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .sign(key, hashes.SHA256())
        )
        secret = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        write_whole(key_path, secret, 0o600)
        write_whole(certificate_path, certificate.public_bytes(serialization.Encoding.PEM), 0o644)
    return certificate_path.read_text(encoding="ascii")


def link_context(home: Path, peer: str, *, server: bool) -> ssl.SSLContext:
    """Return the TLS context of one side, which accepts only the certificate `peer` (PEM).

    Raises `OSError`, and `ssl.SSLError` if a certificate or key is damaged.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if server else ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False  # the certificate is known: it needs no name
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_verify_locations(cadata=peer)
    context.load_cert_chain(home / CERTIFICATE, home / KEY)
    return context


def replication_context(membership: Membership, folder: Path, *, server: bool) -> ssl.SSLContext:
    """Return the TLS context of the replication; key and certificate are written to `folder`.

    Raises `OSError`, and `ssl.SSLError` if a certificate or key is damaged.
    """
    write_whole(folder / KEY, membership.key.encode("ascii"), 0o600)
    write_whole(folder / CERTIFICATE, membership.certificate.encode("ascii"), 0o600)
    return link_context(folder, membership.other_certificate, server=server)
