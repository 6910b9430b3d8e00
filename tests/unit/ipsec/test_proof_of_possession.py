from pathlib import Path

import pytest
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from appliance.ipsec.certificate_authority import CertificateAuthority, RequestRefusedError
from appliance.ipsec.requests import make_key, signing_request


def sign(key: bytes, request: bytes) -> bytes:
    private = load_pem_private_key(key, None)
    assert isinstance(private, ec.EllipticCurvePrivateKey)
    return private.sign(request, ec.ECDSA(hashes.SHA384()))


def test_the_present_key_asks_for_the_next(tmp_path: Path) -> None:
    authority, old, new = CertificateAuthority(tmp_path), make_key(), make_key()
    present = authority.issue(signing_request(old, "a"), "a", 1)
    request = signing_request(new, "a")
    following = authority.issue(request, "a", 1, proof=sign(old, request), former=present.certificate)
    assert following.serial != present.serial


def test_any_other_proof_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "foreign").mkdir()
    authority, foreign = CertificateAuthority(tmp_path / "mine"), CertificateAuthority(tmp_path / "foreign")
    old, thief = make_key(), make_key()
    present = authority.issue(signing_request(old, "a"), "a", 1).certificate
    other = authority.issue(signing_request(old, "b"), "b", 1).certificate
    strange = foreign.issue(signing_request(thief, "a"), "a", 1).certificate
    ended = authority.issue(signing_request(old, "a"), "a", 1e-9).certificate
    request = signing_request(thief, "a")
    for proof, former, reason in (
        (sign(thief, request), present, "not signed by the key"),
        (sign(old, request + b" "), present, "not signed by the key"),
        (b"", present, "not signed by the key"),
        (b"x" * 5000, present, "not signed by the key"),
        (sign(old, request), other, "different name"),
        (sign(thief, request), strange, "not from this authority"),
        (sign(old, request), ended, "has expired"),
        (sign(old, request), b"rubbish", "not from this authority"),
        (sign(old, request), b"", "not from this authority"),
    ):
        with pytest.raises(RequestRefusedError, match=reason):
            authority.issue(request, "a", 1, proof=proof, former=former)
