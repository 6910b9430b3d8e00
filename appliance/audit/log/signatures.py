"""Request signatures of checkpoints, and store the valid ones.

The key of the first valid signature is pinned in `<log>.pub` (PEM); the program never replaces it. A signer refuses
checkpoints older than its last one, so a new signer gets the oldest first.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_public_key

from appliance.audit.log.log_writer import ChainWriter
from appliance.base.atomic_files import write_whole
from appliance.base.input_files import read_given

RemovalSigner = Callable[[int, bytes, bytes], None]
ASKED_AT_ONCE = 64


class CheckpointSigner(Protocol):
    """Requests signatures of checkpoints; the log calls it on its own thread."""

    def __call__(self, number: int, text: bytes, *, oldest: bool) -> None:
        """Request a signature. `oldest`: all earlier checkpoints are signed."""


class KeyUnreadableError(Exception):
    """A public key file is missing or is not an Ed25519 key in PEM."""


def pinned_key_path(log: Path) -> Path:
    return log.with_name(log.stem + ".pub")


def read_public_key(path: Path) -> bytes:
    """Return the raw key (32 bytes). Raises `KeyUnreadableError`."""
    try:
        return parse_public_key(read_given(path), path)
    except OSError as error:
        raise KeyUnreadableError(f"the public key {path} cannot be read: {error.strerror}") from error


def parse_public_key(pem: bytes, path: Path) -> bytes:
    """Return the raw key (32 bytes) of the file at `path`. Raises `KeyUnreadableError`."""
    try:
        key = load_pem_public_key(pem)
    except (ValueError, UnsupportedAlgorithm) as error:
        raise KeyUnreadableError(
            f"{path}: not a public key in PEM; the appliance's is STATE/control/audit.pub"
        ) from error
    if not isinstance(key, Ed25519PublicKey):
        raise KeyUnreadableError(
            f"{path}: not an Ed25519 public key; the appliance's is STATE/control/audit.pub"
        )
    return key.public_bytes_raw()


def signature_is_valid(public_key: bytes, signature: bytes, text: bytes) -> bool:
    try:
        Ed25519PublicKey.from_public_bytes(public_key).verify(signature, text)
    except (InvalidSignature, ValueError):
        return False
    return True


class Signatures:
    """The requests to the signer, and its valid answers."""

    def __init__(self, log: Path, signer: CheckpointSigner | None) -> None:
        self._pin = pinned_key_path(log)
        self._signer = signer
        self._asked: set[int] = set()

    @property
    def has_signer(self) -> bool:
        return self._signer is not None

    @property
    def awaited(self) -> bool:
        return bool(self._asked)

    def ask(self, writer: ChainWriter, *, again: bool = False) -> None:
        """Request the next signatures, at most `ASKED_AT_ONCE` together; `again`: also those requested before."""
        if self._signer is None:
            return
        if again:
            self._asked.clear()
        left = ASKED_AT_ONCE - len(self._asked)
        for number, text in writer.unsigned_checkpoints(max(self._asked, default=0), left):
            oldest = not self._asked
            self._asked.add(number)
            self._signer(number, text, oldest=oldest)

    def keep(self, writer: ChainWriter, number: int, signature: bytes, public_key: bytes) -> str | None:
        """Store a signature, and pin the first key; return the reason if the signature is invalid."""
        text = writer.checkpoint_text(number)
        if text is None:
            return f"there is no checkpoint {number}"
        wrong = self.wrong(f"checkpoint {number}", text, signature, public_key)
        if wrong is not None:
            return wrong
        if not self._pin.exists():
            write_public_key(self._pin, public_key)
        writer.keep_signature(number, signature, public_key)
        self._asked.discard(number)
        if not self._asked:
            self.ask(writer)
        return None

    def wrong(self, what: str, text: bytes, signature: bytes, public_key: bytes) -> str | None:
        if not signature_is_valid(public_key, signature, text):
            return f"the signature of {what} is wrong"
        if not self._pin.exists():
            return None
        try:
            pinned = read_public_key(self._pin)
        except KeyUnreadableError as error:
            return str(error)
        if pinned != public_key:
            keys = f"{public_key.hex()}, {self._pin} has {pinned.hex()}"
            return f"{what} is signed with {keys}; restore the signer's key and this file from one backup"
        return None


def write_public_key(path: Path, public_key: bytes) -> None:
    """Write the key as PEM. Raises `OSError`."""
    key = Ed25519PublicKey.from_public_bytes(public_key)
    text = key.public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    write_whole(path, text, 0o644)
