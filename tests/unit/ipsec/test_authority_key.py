import os
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ed25519

from appliance.ipsec.authority_key import SignerKeyError, read_passphrase
from appliance.ipsec.certificate_authority import CERTIFICATE_FILE, KEY_FILE, CertificateAuthority
from appliance.ipsec.requests import make_key, signing_request


def test_an_ed25519_authority_makes_certificates_and_lists(tmp_path: Path) -> None:
    authority = CertificateAuthority(tmp_path, "ed25519")
    own = x509.load_pem_x509_certificate(authority.certificate)
    assert isinstance(own.public_key(), ed25519.Ed25519PublicKey)
    issued = authority.issue(signing_request(make_key(), "a"), "a", 1)
    x509.load_pem_x509_certificate(issued.certificate).verify_directly_issued_by(own)
    listed = x509.load_pem_x509_crl(authority.revocations([(issued.serial, 1.0)]))
    public = own.public_key()
    assert isinstance(public, ed25519.Ed25519PublicKey)
    assert listed.is_signature_valid(public)
    assert CertificateAuthority(tmp_path, "ed25519").certificate == authority.certificate


def test_a_kind_that_differs_from_the_existing_key_is_an_error(tmp_path: Path) -> None:
    CertificateAuthority(tmp_path)
    with pytest.raises(SignerKeyError, match=r"kind ecdsa, but ipsec\.ca is ed25519: set it to ecdsa"):
        CertificateAuthority(tmp_path, "ed25519")


def test_the_key_is_encrypted_by_its_passphrase(tmp_path: Path) -> None:
    made = CertificateAuthority(tmp_path, passphrase=b"correct horse")
    assert b"ENCRYPTED" in (tmp_path / KEY_FILE).read_bytes()
    assert CertificateAuthority(tmp_path, passphrase=b"correct horse").certificate == made.certificate
    before = (tmp_path / KEY_FILE).read_bytes()
    with pytest.raises(SignerKeyError, match="the passphrase is wrong"):
        CertificateAuthority(tmp_path, passphrase=b"battery")
    with pytest.raises(SignerKeyError, match=r"is encrypted: .* ROSRV_CA_PASSPHRASE_FILE"):
        CertificateAuthority(tmp_path)
    assert (tmp_path / KEY_FILE).read_bytes() == before


def test_a_clear_key_is_encrypted_once_there_is_a_passphrase(tmp_path: Path) -> None:
    made = CertificateAuthority(tmp_path)
    assert CertificateAuthority(tmp_path, passphrase=b"late").certificate == made.certificate
    assert b"ENCRYPTED" in (tmp_path / KEY_FILE).read_bytes()
    assert (tmp_path / KEY_FILE).stat().st_mode & 0o777 == 0o600
    with pytest.raises(SignerKeyError, match="is encrypted"):
        CertificateAuthority(tmp_path)
    assert (tmp_path / CERTIFICATE_FILE).exists()


@pytest.mark.parametrize(
    ("text", "error"), [(b"", "empty"), (b"\nsecond\n", "empty"), (b"x" * 1100, "longer")]
)
def test_a_file_without_a_passphrase_is_an_error(tmp_path: Path, text: bytes, error: str) -> None:
    path = tmp_path / "passphrase"
    path.write_bytes(text)
    with pytest.raises(SignerKeyError, match=error):
        read_passphrase(os.open(path, os.O_RDONLY))


def test_the_first_line_is_the_passphrase(tmp_path: Path) -> None:
    path = tmp_path / "passphrase"
    path.write_bytes(b"one two\r\nthree\n")
    assert read_passphrase(os.open(path, os.O_RDONLY)) == b"one two"
