"""Make the collector's certificate, and read from it the address and the authority that invitations contain."""

from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from appliance.base.atomic_files import write_whole
from appliance.signing.own_certificate import make_own_certificate
from rosrv_fleet.config import FleetConfig

_DAYS = 3650  # every robot pins it, and must join again after a change


class ServerCertificateError(Exception):
    """The collector's certificate is missing or unusable for robots. The message has the remedy."""


def make_certificate(config: FleetConfig, address: str | None) -> bool:
    """Make a key and a certificate, or return False if there is one. Raise `ServerCertificateError` or `OSError`."""
    if config.certificate.exists():
        named = _addresses(config.certificate)
        if address is not None and address not in named:
            raise ServerCertificateError(
                f"{config.certificate} names {', '.join(named) or 'no address'}: to replace it, remove it and its key,"
                " repeat this, restart the collector, and let every robot join again"
            )
        return False
    try:
        key, certificate = make_own_certificate("rosrv-fleet", _DAYS, address or "")
    except ValueError:
        raise ServerCertificateError(
            f"{config.certificate} does not exist: give --address, an address at which robots reach this machine"
        ) from None
    write_whole(config.key, key, 0o600)
    write_whole(config.certificate, certificate, 0o644)
    return True


def authority_of(certificate: Path) -> str:
    """Return the last certificate of the file as PEM. Raise `ServerCertificateError` unless it is self-signed."""
    last = x509.load_pem_x509_certificates(certificate.read_bytes())[-1]
    if last.issuer != last.subject:
        raise ServerCertificateError(
            f"{certificate} does not end with its authority's certificate, which robots need: append it"
        )
    return last.public_bytes(Encoding.PEM).decode("ascii")


def url_of(config: FleetConfig) -> str:
    """Return the URL with the certificate's first address, or raise `ServerCertificateError` if it names none."""
    addresses = _addresses(config.certificate)
    if not addresses:
        raise ServerCertificateError(
            f"{config.certificate} names no IP address in its subjectAltName: make another one"
        )
    shown = f"[{addresses[0]}]" if ":" in addresses[0] else addresses[0]
    return f"https://{shown}:{config.address[1]}"


def names_of(certificate: Path) -> list[str]:
    """Return the host names in the certificate; one may begin with `*.`."""
    names = _alternative_names(certificate)
    return [] if names is None else names.get_values_for_type(x509.DNSName)


def _addresses(certificate: Path) -> list[str]:
    names = _alternative_names(certificate)
    return [] if names is None else [str(address) for address in names.get_values_for_type(x509.IPAddress)]


def _alternative_names(certificate: Path) -> x509.SubjectAlternativeName | None:
    first = x509.load_pem_x509_certificates(certificate.read_bytes())[0]
    try:
        return first.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return None
