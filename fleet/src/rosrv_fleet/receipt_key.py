"""Make and read the key with which the collector signs receipts."""

from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
)

from appliance.base.atomic_files import write_whole


class ReceiptKeyError(Exception):
    """The key is missing or unreadable."""


def make_receipt_key(folder: Path) -> Path:
    """Make the key if it does not exist yet. Return the file of its public key, which robots need."""
    file, public = folder / "receipts.key", folder / "receipts.pub"
    if not file.exists():
        made = Ed25519PrivateKey.generate()
        write_whole(file, made.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()), 0o600)
    key = read_receipt_key(folder)
    write_whole(public, key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo), 0o644)
    return public


def read_receipt_key(folder: Path) -> Ed25519PrivateKey:
    file = folder / "receipts.key"
    try:
        key = load_pem_private_key(file.read_bytes(), password=None)
    except OSError as error:
        raise ReceiptKeyError(f"{file}: {error.strerror}; run 'rosrv-fleet init'") from error
    except ValueError as error:
        raise ReceiptKeyError(f"{file}: {error}; restore it from a backup") from error
    if not isinstance(key, Ed25519PrivateKey):
        raise ReceiptKeyError(f"{file}: not an Ed25519 key; restore it from a backup")
    return key
