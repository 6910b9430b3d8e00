"""The link control <-> signer, for signatures of audit checkpoints and for certificates."""

from typing import Annotated

import msgspec

from appliance.channel.messages.message import Message


class SignatureWanted(Message):
    """Control asks the signer to sign an audit checkpoint."""

    number: int
    text: bytes


class SignatureMade(Message):
    """The signer returns its Ed25519 signature of `SignatureWanted.text` (64 bytes), and its public key (32 bytes)."""

    number: int
    signature: bytes
    public_key: bytes


class SignatureRefused(Message):
    """The signer refuses to sign a checkpoint that does not follow the last signed checkpoint, for this reason."""

    number: int
    reason: str


class RemovalWanted(Message):
    """Control asks the signer to approve the removal of all records up to checkpoint `number`.

    `checkpoint` is the text of this checkpoint, `newest` the text of the last signed checkpoint.
    """

    number: int
    checkpoint: bytes
    newest: bytes


class RemovalApproved(Message):
    """The settings require the removal. The signer returns the removal's text, and its signature over the text."""

    number: int
    text: bytes
    signature: bytes
    public_key: bytes


class RemovalRefused(Message):
    """The settings do not permit the removal, for this reason. `early`: they will permit it later."""

    number: int
    reason: str
    early: bool = False


class AuthorityRequest(Message):
    """Control asks for the certificate of the appliance's authority. An answer has the `number` of its request."""

    number: int


class AuthorityStated(Message):
    """The signer returns the certificate (PEM) of the authority whose key it has.

    `trouble` says why it cannot use the sealed key of the other appliance's authority; empty if it can, or has none.
    """

    number: int
    certificate: bytes
    trouble: str = ""


class CertificateWanted(Message):
    """Control asks for a certificate in this name, for the key in a signing request (PKCS #10, PEM).

    `proof`, if given, must be a signature over the bytes of `request` by the key of the certificate `former` (PEM). The
    authority must have issued `former` for the same name.
    """

    number: int
    request: bytes
    name: str
    days: float
    proof: bytes = b""
    former: bytes = b""


class CertificateMade(Message):
    """The signer returns the certificate (PEM), its serial number (hexadecimal) and its end (s since the epoch)."""

    number: int
    certificate: bytes
    serial: str
    expires: float


class CertificateRefused(Message):
    """The signer refuses to make a certificate for this request, for this reason."""

    number: int
    reason: str


class RevokedCertificate(msgspec.Struct, frozen=True):
    """A serial number in hexadecimal, at most 160 bits, and the time of the revocation (seconds since the epoch)."""

    serial: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{1,40}$")]
    moment: Annotated[float, msgspec.Meta(ge=0, le=4_000_000_000)]


class RevocationsRequest(Message):
    """Control asks for a signed list of exactly these revoked certificates."""

    number: int
    revoked: list[RevokedCertificate]


class RevocationsMade(Message):
    """The signer returns the signed list of revoked certificates (CRL, PEM)."""

    number: int
    revocations: bytes


SignerLink = (
    SignatureWanted | SignatureMade | SignatureRefused | RemovalWanted | RemovalApproved | RemovalRefused
    | AuthorityRequest | AuthorityStated | CertificateWanted | CertificateMade | CertificateRefused | RevocationsRequest
    | RevocationsMade
)  # fmt: skip
