"""The link control <-> signer: signatures of audit checkpoints, certificates."""

from typing import Annotated

import msgspec

from appliance.channel.messages.message import Message


class SignatureWanted(Message):
    """Control asks the signer to sign an audit checkpoint."""

    number: int
    text: bytes


class SignatureMade(Message):
    """The signer's Ed25519 signature (64 bytes) over `SignatureWanted.text`, and its raw public key (32)."""

    number: int
    signature: bytes
    public_key: bytes


class SignatureRefused(Message):
    """The signer's refusal to sign a checkpoint that does not follow the last signed one, with the reason."""

    number: int
    reason: str


class RemovalWanted(Message):
    """Control asks the signer to approve the removal of all records up to checkpoint `number`.

    `checkpoint` is its text, `newest` that of the last checkpoint that was signed.
    """

    number: int
    checkpoint: bytes
    newest: bytes


class RemovalApproved(Message):
    """The removal follows from the settings: its text, and the signer's signature over it."""

    number: int
    text: bytes
    signature: bytes
    public_key: bytes


class RemovalRefused(Message):
    """The removal does not follow from the settings, with the reason. `early`: it will later."""

    number: int
    reason: str
    early: bool = False


class AuthorityRequest(Message):
    """Control asks the signer for the certificate of the appliance's authority; `number` pairs all these."""

    number: int


class AuthorityStated(Message):
    """The authority's certificate, in PEM."""

    number: int
    certificate: bytes


class CertificateWanted(Message):
    """Control asks for a certificate in this name for the key of a signing request (PKCS #10, PEM).

    A `proof` must be a signature over the bytes of `request`, by the key of the certificate `former` (PEM), which the
    authority made for the same name.
    """

    number: int
    request: bytes
    name: str
    days: float
    proof: bytes = b""
    former: bytes = b""


class CertificateMade(Message):
    """The certificate (PEM), its serial number in hexadecimal, and its end in seconds since the epoch."""

    number: int
    certificate: bytes
    serial: str
    expires: float


class CertificateRefused(Message):
    """The signer's refusal to make a certificate for this request, with the reason."""

    number: int
    reason: str


class RevokedCertificate(msgspec.Struct, frozen=True):
    """A serial number in hexadecimal, at most 160 bits, and the time of the revocation (seconds since the epoch)."""

    serial: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{1,40}$")]
    moment: Annotated[float, msgspec.Meta(ge=0, le=4_000_000_000)]


class RevocationsRequest(Message):
    """Control asks for the signed list of exactly these revoked certificates."""

    number: int
    revoked: list[RevokedCertificate]


class RevocationsMade(Message):
    """The list of revoked certificates (CRL, PEM)."""

    number: int
    revocations: bytes


SignerLink = (
    SignatureWanted | SignatureMade | SignatureRefused | RemovalWanted | RemovalApproved | RemovalRefused
    | AuthorityRequest | AuthorityStated | CertificateWanted | CertificateMade | CertificateRefused | RevocationsRequest
    | RevocationsMade
)  # fmt: skip
