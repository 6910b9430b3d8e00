import base64
import datetime
import stat
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import NameOID

from appliance.base.clock import using, utc_now, wall
from appliance.ipsec.authority_key import SignerKeyError
from appliance.ipsec.certificate_authority import (
    CERTIFICATE_FILE,
    KEY_FILE,
    LIST_FILE,
    LONGEST_REQUEST,
    CertificateAuthority,
    RequestRefusedError,
)
from tests.support.virtual_clock import VirtualClock


def request_of(
    key: ec.EllipticCurvePrivateKey | ed25519.Ed25519PrivateKey | rsa.RSAPrivateKey, name: str = "whoever"
) -> bytes:
    digest = None if isinstance(key, ed25519.Ed25519PrivateKey) else hashes.SHA384()
    return (
        x509.CertificateSigningRequestBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)]))
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("rosrv-appliance")]), critical=False)
        .sign(key, digest)
        .public_bytes(Encoding.PEM)
    )


@pytest.mark.parametrize("kind", ["p384", "ed25519"])
def test_a_certificate_takes_only_the_key_from_the_request(tmp_path: Path, kind: str) -> None:
    authority = CertificateAuthority(tmp_path)
    key = ec.generate_private_key(ec.SECP384R1()) if kind == "p384" else ed25519.Ed25519PrivateKey.generate()
    issued = authority.issue(request_of(key), "ocu-1", 90)
    made = x509.load_pem_x509_certificate(issued.certificate)
    root = x509.load_pem_x509_certificate(authority.certificate)
    made.verify_directly_issued_by(root)
    assert made.public_key() == key.public_key()
    assert made.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value == "ocu-1"
    names = made.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert list(names) == [x509.DNSName("ocu-1")]
    assert not made.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    assert not made.extensions.get_extension_for_class(x509.KeyUsage).value.key_cert_sign
    assert int(issued.serial, 16) == made.serial_number
    left = made.not_valid_after_utc - utc_now()
    assert datetime.timedelta(days=89) < left <= datetime.timedelta(days=90)
    assert issued.expires == made.not_valid_after_utc.timestamp()


def test_a_weak_key_is_refused(tmp_path: Path) -> None:
    authority = CertificateAuthority(tmp_path)
    for key in (rsa.generate_private_key(65537, 2048), ec.generate_private_key(ec.SECP256R1())):
        with pytest.raises(RequestRefusedError, match="P-384 nor Ed25519"):
            authority.issue(request_of(key), "ocu-1", 90)


def test_a_request_without_its_key_is_refused(tmp_path: Path) -> None:
    key = ec.generate_private_key(ec.SECP384R1())
    der = x509.load_pem_x509_csr(request_of(key, "aaaaaaa")).public_bytes(Encoding.DER)
    changed = x509.load_der_x509_csr(der.replace(b"aaaaaaa", b"bbbbbbb")).public_bytes(Encoding.PEM)
    with pytest.raises(RequestRefusedError, match="not signed by its own key"):
        CertificateAuthority(tmp_path).issue(changed, "ocu-1", 90)


@pytest.mark.parametrize(
    "request_text",
    [b"", b"\0" * 100, b"-----BEGIN CERTIFICATE REQUEST-----\nMA==\n-----END CERTIFICATE REQUEST-----\n"],
)
def test_an_invalid_request_is_refused(tmp_path: Path, request_text: bytes) -> None:
    with pytest.raises(RequestRefusedError, match="not a signing request"):
        CertificateAuthority(tmp_path).issue(request_text, "ocu-1", 90)


def with_another_version(request: bytes) -> bytes:
    """Return the request as version 3, written where 0 denotes the only version of PKCS #10."""
    der = x509.load_pem_x509_csr(request).public_bytes(Encoding.DER)
    start = der.index(b"\x02\x01\x00")
    text = base64.encodebytes(der[:start] + b"\x02\x01\x02" + der[start + 3 :])
    return b"-----BEGIN CERTIFICATE REQUEST-----\n" + text + b"-----END CERTIFICATE REQUEST-----\n"


def test_a_request_of_another_version_is_refused(tmp_path: Path) -> None:
    authority = CertificateAuthority(tmp_path)
    request = with_another_version(request_of(ec.generate_private_key(ec.SECP384R1())))
    with pytest.raises(RequestRefusedError, match="not a signing request"):
        authority.issue(request, "ocu-1", 90)


def test_limits_of_a_request(tmp_path: Path) -> None:
    authority = CertificateAuthority(tmp_path)
    good = request_of(ec.generate_private_key(ec.SECP384R1()))
    for name in ("", "-x", "a b", "x" * 64, "../x", "a\n", 'a"b'):
        with pytest.raises(RequestRefusedError, match="is not a valid name"):
            authority.issue(good, name, 90)
    for days in (0, -1, 399, float("nan")):
        with pytest.raises(RequestRefusedError, match="at most 398 days"):
            authority.issue(good, "ocu-1", days)
    with pytest.raises(RequestRefusedError, match="longer than"):
        authority.issue(good + b" " * LONGEST_REQUEST, "ocu-1", 90)


def test_the_list_of_revoked_certificates_is_signed_and_complete(tmp_path: Path) -> None:
    authority = CertificateAuthority(tmp_path)
    root = x509.load_pem_x509_certificate(authority.certificate)
    first = x509.load_pem_x509_crl(authority.revocations([]))
    second = x509.load_pem_x509_crl(authority.revocations([("a1b2", 1_700_000_000.0)]))
    assert len(first) == 0
    assert [one.serial_number for one in second] == [0xA1B2]
    public_key = root.public_key()
    assert isinstance(public_key, ec.EllipticCurvePublicKey)
    assert second.is_signature_valid(public_key)


def number_of(revocations: bytes) -> int:
    extension = x509.load_pem_x509_crl(revocations).extensions.get_extension_for_class(x509.CRLNumber)
    return extension.value.crl_number


def test_the_number_of_the_list_grows_whatever_the_clock_does(tmp_path: Path) -> None:
    """charon ignores a list with a lower number, and would accept certificates that were revoked since."""
    numbers = [number_of(CertificateAuthority(tmp_path).revocations([]))]
    with using(VirtualClock(wall=wall() - 3600)):
        authority = CertificateAuthority(tmp_path)  # the signer was started again
        numbers += [number_of(authority.revocations([])) for _ in range(2)]
        (tmp_path / LIST_FILE).unlink()
        (tmp_path / LIST_FILE).mkdir()  # nothing can be written any more
        numbers.append(number_of(authority.revocations([])))
    assert numbers == sorted(set(numbers))
    (tmp_path / LIST_FILE).rmdir()
    (tmp_path / LIST_FILE).write_bytes(b"")
    with pytest.raises(SignerKeyError, match="damaged"):
        CertificateAuthority(tmp_path)


def test_the_authority_is_made_once(tmp_path: Path) -> None:
    first = CertificateAuthority(tmp_path).certificate
    assert CertificateAuthority(tmp_path).certificate == first
    assert stat.S_IMODE((tmp_path / KEY_FILE).stat().st_mode) == 0o600
    root = x509.load_pem_x509_certificate(first)
    assert root.extensions.get_extension_for_class(x509.BasicConstraints).value.path_length == 0


def test_a_damaged_authority_is_an_error_and_never_replaced(tmp_path: Path) -> None:
    CertificateAuthority(tmp_path)
    other = tmp_path / "other"
    other.mkdir()
    CertificateAuthority(other)
    key, certificate = tmp_path / KEY_FILE, tmp_path / CERTIFICATE_FILE
    text = certificate.read_bytes()

    certificate.write_bytes((other / CERTIFICATE_FILE).read_bytes())
    with pytest.raises(SignerKeyError, match="is not the certificate of"):
        CertificateAuthority(tmp_path)
    certificate.write_bytes(b"rubbish")
    with pytest.raises(SignerKeyError, match="not a certificate"):
        CertificateAuthority(tmp_path)
    assert certificate.read_bytes() == b"rubbish"
    certificate.unlink()
    with pytest.raises(SignerKeyError, match="but its key is there"):
        CertificateAuthority(tmp_path)
    certificate.write_bytes(text)
    key.chmod(0o640)
    with pytest.raises(SignerKeyError, match="others may read"):
        CertificateAuthority(tmp_path)
    key.chmod(0o600)
    key.write_bytes(b"rubbish")
    with pytest.raises(SignerKeyError, match="not a private key"):
        CertificateAuthority(tmp_path)
    key.unlink()
    with pytest.raises(SignerKeyError, match="but its certificate is there"):
        CertificateAuthority(tmp_path)
