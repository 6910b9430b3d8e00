"""Run the signer: the process with the audit key and the authority's key. It has no network.

1. The audit key never leaves the process. A damaged key file, or one readable by others, is an error; it is never
   replaced.
2. The signer parses only the messages of its lifeline and its link to control, and the signing requests in them.
3. Every signing request is answered, even if parsing it raises an unexpected error, so later messages are served.
"""

import asyncio
import os
import socket
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
)

from appliance.base.age_clock import AgeClock
from appliance.base.atomic_files import write_whole
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.child_process import Child
from appliance.ipsec.authority_key import Kind, SignerKeyError, read_passphrase, require_private
from appliance.ipsec.brought_authority import open_authority
from appliance.ipsec.certificate_authority import CertificateAuthority, RequestRefusedError
from appliance.ipsec.signed_checkpoints import (
    CheckpointMemory,
    CheckpointRefusedError,
    newest_signing,
    read_checkpoint,
)
from appliance.signing.log_proof import Checkpoint, Removal, checkpoint_hash
from appliance.signing.signed_logs import sync_index

# Approve removals of old audit records if the settings and the signer's own memory justify them.
#
# Without approval, a process that can write the log could remove recent records and call them old.
#
# 1. Records are removed up to a checkpoint that the signer signed.
# 2. By age: the signer signed that checkpoint long enough ago, by the age clock.
# 3. By size: the records sealed since that checkpoint would fill the size if each had `LARGEST_RECORD` bytes.

LARGEST_RECORD = 64 << 10
"""The assumed bytes of a record with the largest details; the average is smaller."""

_DAY = 86_400_000_000_000


class RemovalRefusedError(Exception):
    """A removal is refused; `early`: it may be permitted later."""

    def __init__(self, reason: str, *, early: bool = False) -> None:
        super().__init__(reason)
        self.early = early


@dataclass(frozen=True)
class RetentionLimits:
    """The limits of a log: age in days, size in bytes."""

    days: float | None = None
    size: int | None = None


class RemovalJudge:
    """Approves removals by the signatures in `signed` and the limits in `kept`.

    `dated` corrects a date of `clock` from a time when a long gap did not count yet.
    """

    def __init__(
        self,
        signed: CheckpointMemory,
        kept: RetentionLimits,
        clock: Callable[[], int],
        dated: Callable[[int], int] = int,
    ) -> None:
        self._signed = signed
        self._kept = kept
        self._clock = clock
        self._dated = dated

    def accept(self, checkpoint: bytes, newest: bytes) -> bytes:
        """Return the text to sign. `newest` is the last signed checkpoint.

        Raises `RemovalRefusedError`, `CheckpointRefusedError`, `OSError`.
        """
        upto, last = read_checkpoint(checkpoint), read_checkpoint(newest)
        signed_at = self._signed.signed_at(upto)
        if signed_at is None:
            raise RemovalRefusedError(f"checkpoint {upto.number} was not signed here")
        why = self._by_age(signed_at) or self._by_size(upto, last)
        if not why:
            raise RemovalRefusedError(self._words(upto), early=self._kept.days is not None)
        self._signed.remember_removed(upto.log, max(upto.sequence, self._signed.removed(upto.log) or 0))
        sealed = checkpoint_hash(checkpoint)
        return Removal(upto.log, upto.number, upto.sequence, upto.hash, sealed, why).text()

    def _by_age(self, signed_at: int) -> str:
        days = self._kept.days
        now = self._clock()  # first: it may count a gap
        old = days is not None and now - self._dated(signed_at) >= int(days * _DAY)
        return f"{days} days" if old else ""

    def _by_size(self, upto: Checkpoint, last: Checkpoint) -> str:
        size = self._kept.size
        if size is None or last.log != upto.log or self._signed.signed_at(last) is None:
            return ""
        return f"{size} bytes" if (last.sequence - upto.sequence) * LARGEST_RECORD >= size else ""

    def _words(self, upto: Checkpoint) -> str:
        if self._kept.days is None and self._kept.size is None:
            return "records are kept forever: neither audit.retention_days nor audit.retention_bytes is set"
        return (
            f"records up to {upto.sequence} are not old enough for audit.retention_days, and too few came after them"
            " for audit.retention_bytes"
        )


KEY_FILE = "audit.key"
PUBLIC_KEY_FILE = "audit.pub"


class _Audit(msgspec.Struct):
    retention_days: float | None
    retention_bytes: int | None


class _Ipsec(msgspec.Struct):
    ca: Kind


class _Settings(msgspec.Struct):
    state: str
    audit: _Audit
    ipsec: _Ipsec


def load_or_create_key(directory: Path) -> Ed25519PrivateKey:
    """Return the audit key, made if missing. Raises `SignerKeyError` or `OSError`."""
    path = directory / KEY_FILE
    if not path.exists():
        _create_key(directory)
    require_private(path)
    try:
        key = load_pem_private_key(path.read_bytes(), password=None)
    except (ValueError, TypeError) as error:
        raise SignerKeyError(
            f"{path}: not a private key in PEM: {error}; restore it from a backup"
        ) from error
    if not isinstance(key, Ed25519PrivateKey):
        raise SignerKeyError(f"{path}: not an Ed25519 key; restore it from a backup")
    public = key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    write_whole(directory / PUBLIC_KEY_FILE, public, 0o644)
    return key


def _create_key(directory: Path) -> None:
    if (directory / PUBLIC_KEY_FILE).exists():
        raise SignerKeyError(f"{directory / KEY_FILE}: missing, but its public half is there; restore it from"
                             " a backup, or remove control/audit.* and signer/* to begin a new log")  # fmt: skip
    key = Ed25519PrivateKey.generate()
    write_whole(
        directory / KEY_FILE, key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()), 0o600
    )


class Signer:
    """Handles messages of the supervisor and of control."""

    def __init__(
        self,
        lifeline: Channel,
        directory: Path,
        key: Ed25519PrivateKey,
        authority: CertificateAuthority,
        kept: RetentionLimits,
        *,
        trouble: str = "",
    ) -> None:
        self._child = Child(lifeline, messages.SignerLink, said=self._control_said)
        self._authority = authority
        self._trouble = trouble
        clock = AgeClock(directory / "age", lambda: newest_signing(directory))
        sync_index(directory)
        self._signed = CheckpointMemory(directory, clock)
        self._removals = RemovalJudge(self._signed, kept, clock, clock.true_date)
        self._key = key
        self._public_key = key.public_key().public_bytes_raw()

    async def run(self) -> None:
        self._child.attach(messages.Ready(detail={"public_key": self._public_key.hex()}))
        await self._child.ended.wait()
        self._child.close()

    def _control_said(self, message: object) -> None:
        answer = self._answer(message)
        if answer is not None:
            self._child.tell(answer)

    def _answer(self, message: object) -> messages.Message | None:
        match message:
            case messages.SignatureWanted(number, text):
                return self._sign(number, text)
            case messages.RemovalWanted(number, checkpoint, newest):
                return self._accept_removal(number, checkpoint, newest)
            case messages.AuthorityRequest(number):
                return messages.AuthorityStated(number, self._authority.certificate, self._trouble)
            case messages.CertificateWanted():
                return self._issue(message)
            case messages.RevocationsRequest(number, revoked):
                rows = [(certificate.serial, certificate.moment) for certificate in revoked]
                return messages.RevocationsMade(number, self._authority.revocations(rows))
            case _:
                return None

    def _sign(self, number: int, text: bytes) -> messages.Message:
        try:
            self._signed.accept(text)
            others = tuple(self._signed.others(text))
        except (CheckpointRefusedError, OSError, ValueError) as error:
            return messages.SignatureRefused(number, str(error))
        return messages.SignatureMade(number, self._key.sign(text), self._public_key, others)

    def _accept_removal(self, number: int, checkpoint: bytes, newest: bytes) -> messages.Message:
        try:
            text = self._removals.accept(checkpoint, newest)
        except (RemovalRefusedError, CheckpointRefusedError, OSError) as error:
            early = isinstance(error, RemovalRefusedError) and error.early
            return messages.RemovalRefused(number, str(error), early)
        return messages.RemovalSigned(number, text, self._key.sign(text), self._public_key)

    def _issue(self, wanted: messages.CertificateWanted) -> messages.Message:
        try:
            issued = self._authority.issue(
                wanted.request, wanted.name, wanted.days, proof=wanted.proof, former=wanted.former
            )
        except RequestRefusedError as error:
            return messages.CertificateRefused(wanted.number, str(error))
        except Exception as error:  # noqa: BLE001  untrusted bytes: every request is answered
            return messages.CertificateRefused(
                wanted.number, f"the signing request cannot be used: {type(error).__name__}: {error}"
            )
        return messages.CertificateMade(wanted.number, issued.certificate, issued.serial, issued.expires)


def main(lifeline_fd: int, config: Path, passphrase: int | None) -> None:
    settings = msgspec.json.decode(config.read_bytes(), type=_Settings)
    kept = RetentionLimits(settings.audit.retention_days, settings.audit.retention_bytes)
    serve(lifeline_fd, Path(settings.state, "signer"), settings.ipsec.ca, passphrase, kept)


def serve(
    lifeline_fd: int,
    directory: Path,
    kind: Kind = "ecdsa",
    passphrase: int | None = None,
    kept: RetentionLimits = RetentionLimits(),
) -> None:
    lifeline = Channel(socket.socket(fileno=lifeline_fd), messages.Lifeline)
    try:
        os.umask(0o077)
        secret = read_passphrase(passphrase) if passphrase is not None else None
        signer = open_signer(lifeline, directory, kind, secret, kept)
    except (SignerKeyError, OSError) as error:
        lifeline.send(messages.Failed(f"the signer cannot use its key: {error}"))
        lifeline.close()
        sys.exit(1)
    asyncio.run(signer.run())


def open_signer(
    lifeline: Channel,
    directory: Path,
    kind: Kind = "ecdsa",
    secret: bytes | None = None,
    kept: RetentionLimits = RetentionLimits(),
) -> Signer:
    """Return the signer with the keys in a directory, made if missing. Raises `SignerKeyError` or `OSError`."""
    key = load_or_create_key(directory)
    authority, trouble = open_authority(directory, kind, secret)
    return Signer(lifeline, directory, key, authority, kept, trouble=trouble)
