"""Keep the signing keys of bundles as encrypted PEM files, each with one Ed25519 key, named by role and key id."""

import re
from collections.abc import Callable, Collection
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from securesystemslib.signer import CryptoSigner, Key

from appliance.base.atomic_files import write_whole

_FILE = re.compile(r"(.+)\.([0-9a-f]{16})\.pem")
_ID_DIGITS = 16
_SHORTEST = 8


class KeyFileError(Exception):
    """A key cannot be read or made."""


class KeyFolder:
    """The folder of key files. It asks for each passphrase once."""

    def __init__(self, folder: Path, passphrase: Callable[[Path], str]) -> None:
        self.folder = folder
        self._passphrase = passphrase
        self._signers: dict[Path, CryptoSigner] = {}

    def make(self, role: str) -> Key:
        signer = CryptoSigner.generate_ed25519()
        path = self.folder / f"{role}.{signer.public_key.keyid[:_ID_DIGITS]}.pem"
        passphrase = self._passphrase(path)
        if len(passphrase) < _SHORTEST:
            raise KeyFileError(f"the passphrase of {path.name} must have at least {_SHORTEST} characters")
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_whole(path, _pem(signer, passphrase), 0o600)
        self._signers[path] = signer
        return signer.public_key

    def signers(self, role: str, keyids: Collection[str]) -> list[CryptoSigner]:
        """Return the role's keys with these ids. Raises `KeyFileError` if the role has none of them."""
        found = []
        for path in sorted(self.folder.glob("*.pem")):
            name = _FILE.fullmatch(path.name)
            if name is not None and name[1] == role and any(keyid.startswith(name[2]) for keyid in keyids):
                found.append(self._load(path))
        if not found:
            raise KeyFileError(
                f"{self.folder} has no key of role {role}: give its folder with --keys{_if_lost(role)}"
            )
        return found

    def _load(self, path: Path) -> CryptoSigner:
        if path not in self._signers:
            try:
                key = load_pem_private_key(path.read_bytes(), self._passphrase(path).encode())
            except (ValueError, TypeError) as error:
                raise KeyFileError(f"{path}: the passphrase is wrong, or the file is damaged") from error
            if not isinstance(key, Ed25519PrivateKey):
                raise KeyFileError(f"{path} is not an Ed25519 key")
            self._signers[path] = CryptoSigner(key)
        return self._signers[path]


def _if_lost(role: str) -> str:
    if role == "root":
        return "; if it is lost, make a new repository, and give its root.json to the robots"
    return f"; if it is lost: rosrv-fleet bundle rotate {role}"


def make_online_key(path: Path) -> Key:
    signer = CryptoSigner.generate_ed25519()
    write_whole(path, _pem(signer, None), 0o600)
    return signer.public_key


def load_online_key(path: Path) -> CryptoSigner:
    try:
        key = load_pem_private_key(path.read_bytes(), None)
    except (OSError, ValueError, TypeError) as error:
        advice = f"copy it from the repository{_if_lost('timestamp')}"
        raise KeyFileError(f"{path}: the timestamp key cannot be read: {error}; {advice}") from error
    if not isinstance(key, Ed25519PrivateKey):
        raise KeyFileError(f"{path} is not an Ed25519 key")
    return CryptoSigner(key)


def _pem(signer: CryptoSigner, passphrase: str | None) -> bytes:
    key = load_pem_private_key(signer.private_bytes, None)
    encryption = NoEncryption() if passphrase is None else BestAvailableEncryption(passphrase.encode())
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, encryption)
