"""Verify that the holder of an earlier certificate made a signing request. No I/O."""

import datetime

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.x509.oid import NameOID

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
