"""The link control <-> signer, for signatures of audit checkpoints and for certificates."""

from typing import Annotated

import msgspec

from appliance.channel.messages.message import Message
from appliance.signing.signed_logs import OtherLog


class SignatureWanted(Message):
    """Control asks for the signature of an audit checkpoint, which is `text`."""

    number: int
    text: bytes


class SignatureMade(Message):
    """An Ed25519 signature (64 bytes), and the public key (32 bytes).

    `others` are the logs that were signed besides the one of this checkpoint.
    """

    number: int
    signature: bytes
    public_key: bytes
    others: tuple[OtherLog, ...] = ()


class SignatureRefused(Message):
    """The signer refuses, because the checkpoint does not follow the last signed one."""

    number: int
    reason: str


class RemovalWanted(Message):
    """Control asks to remove all records up to a checkpoint; `newest` is the last signed one."""

    number: int
    checkpoint: bytes
    newest: bytes


class RemovalSigned(Message):
    """The settings require the removal; the signature is over `text`."""

    number: int
    text: bytes
    signature: bytes
    public_key: bytes


class RemovalRefused(Message):
    """The settings do not permit the removal; `early`: they will permit it later."""

    number: int
    reason: str
    early: bool = False


class AuthorityRequest(Message):
    """Control asks for the certificate of the appliance's authority."""

    number: int


class AuthorityStated(Message):
    """The certificate (PEM) of the authority whose key the signer has.

    `trouble`: the signer cannot use the sealed key of the other appliance's authority.
    """

    number: int
    certificate: bytes
    trouble: str = ""


class CertificateWanted(Message):
    """Control asks for a certificate; `request` is PKCS #10, in PEM.

    `proof`, if given, must be a signature over the bytes of `request` by the key of the certificate `former` (PEM),
    which the authority must have issued for the same name.
    """

    number: int
    request: bytes
    name: str
    days: float
    proof: bytes = b""
    former: bytes = b""


class CertificateMade(Message):
    """The certificate is PEM, the serial number hexadecimal, and the end in seconds since the epoch."""

    number: int
    certificate: bytes
    serial: str
    expires: float


class CertificateRefused(Message):
    """The signer makes no certificate, for this reason."""

    number: int
    reason: str


class RevokedCertificate(msgspec.Struct, frozen=True):
    """A serial number of at most 160 bits, and the time of the revocation (seconds since the epoch)."""

    serial: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{1,40}$")]
    moment: Annotated[float, msgspec.Meta(ge=0, le=4_000_000_000)]


class RevocationsRequest(Message):
    """Control asks for a revocation list of exactly these certificates."""

    number: int
    revoked: list[RevokedCertificate]


class RevocationsMade(Message):
    """The revocation list, a CRL in PEM."""

    number: int
    revocations: bytes


SignerLink = (
    SignatureWanted | SignatureMade | SignatureRefused | RemovalWanted | RemovalSigned | RemovalRefused
    | AuthorityRequest | AuthorityStated | CertificateWanted | CertificateMade | CertificateRefused | RevocationsRequest
    | RevocationsMade
)  # fmt: skip
