"""Make and check the certificates of the link between two appliances: TLS 1.3, each side knows the other's
exactly.

No authority signs them, and they do not expire, so neither the authority's key nor the time of day matters.
"""

import datetime
import ssl
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from appliance.base.atomic_files import write_whole
from appliance.features.standby.membership import Membership

CERTIFICATE = "standby.pem"
KEY = "standby-key.pem"
_BEGIN = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)  # where a clock begins that was never set
_END = datetime.datetime(9999, 12, 31, 23, 59, 59, tzinfo=datetime.UTC)  # RFC 5280: no expiry


class LinkCertificate(NamedTuple):
    """A certificate and its private key (PEM)."""

    certificate: str
    key: str


def make_link_certificate() -> LinkCertificate:
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
    public = certificate.public_bytes(serialization.Encoding.PEM)
    return LinkCertificate(public.decode("ascii"), secret.decode("ascii"))


def link_context(own: LinkCertificate, peer: str, folder: Path, *, server: bool) -> ssl.SSLContext:
    write_whole(folder / KEY, own.key.encode("ascii"), 0o600)
    write_whole(folder / CERTIFICATE, own.certificate.encode("ascii"), 0o600)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if server else ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False  # the certificate is known: it needs no name
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_verify_locations(cadata=peer)
    context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
    return context


def replication_context(membership: Membership, folder: Path, *, server: bool) -> ssl.SSLContext:
    own = LinkCertificate(membership.certificate, membership.key)
    try:
        return link_context(own, membership.other_certificate, folder, server=server)
    except ssl.SSLError as error:
        raise OSError(
            f"the certificates of the two appliances cannot be used ({error}); on the active appliance, run"
            " `rosrv standby join … --force`, and use the new kit"
        ) from error
