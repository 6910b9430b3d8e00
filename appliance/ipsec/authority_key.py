"""Make, store and load the authority's private key, encrypted if there is a passphrase."""

import os
import stat
from pathlib import Path
from typing import Literal

from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)

from appliance.base.atomic_files import write_whole

# Reject key files that others may read.


class SignerKeyError(Exception):
    """A key cannot be used."""


def require_private(path: Path) -> None:
    mode = path.stat().st_mode
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise SignerKeyError(
            f"{path}: others may read this private key (mode {mode & 0o777:o});"
            " treat it as stolen, or set its mode to 600 if you know better"
        )


Kind = Literal["ecdsa", "ed25519"]
Key = ec.EllipticCurvePrivateKey | ed25519.Ed25519PrivateKey
SETTING, PASSPHRASE_SETTING = "ipsec.ca", "ipsec.ca_passphrase_file"
_LONGEST_PASSPHRASE = 1023  # bytes, OpenSSL's limit
_ENCRYPTED = b"-----BEGIN ENCRYPTED PRIVATE KEY-----"


def make_key(kind: Kind) -> Key:
    return (
        ec.generate_private_key(ec.SECP384R1()) if kind == "ecdsa" else ed25519.Ed25519PrivateKey.generate()
    )


def read_passphrase(descriptor: int) -> bytes:
    """Return the first line of the file, and close it. Raises `SignerKeyError`, `OSError`."""
    with os.fdopen(descriptor, "rb") as file:
        line = file.read(_LONGEST_PASSPHRASE + 2).partition(b"\n")[0].rstrip(b"\r")
    if not line:
        raise SignerKeyError(
            f"the file that {PASSPHRASE_SETTING} names is empty: its first line is the passphrase"
        )
    if len(line) > _LONGEST_PASSPHRASE:
        raise SignerKeyError(
            f"the first line of the file that {PASSPHRASE_SETTING} names is longer than {_LONGEST_PASSPHRASE} bytes"
        )
    return line


def is_encrypted(data: bytes) -> bool:
    return data.lstrip().startswith(_ENCRYPTED)


def write_key(path: Path, key: Key, passphrase: bytes | None) -> None:
    encryption = NoEncryption() if passphrase is None else BestAvailableEncryption(passphrase)
    write_whole(path, key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, encryption), 0o600)


def load_key(path: Path, certificate_file: str, kind: Kind, passphrase: bytes | None) -> Key:
    """Return the key; encrypt its file if there is a passphrase. Raises `OSError` and `SignerKeyError`."""
    if not path.exists():
        raise SignerKeyError(
            f"{path}: missing, but its certificate is there; restore it from a backup, or remove"
            f" {certificate_file} to start with a new authority (every host enrols again)"
        )
    require_private(path)
    data = path.read_bytes()
    encrypted = is_encrypted(data)
    key = _decode(path, data, passphrase if encrypted else None, encrypted=encrypted)
    found = _kind(path, key)
    if found != kind:
        raise SignerKeyError(
            f"{path} is an authority's key of the kind {found}, but {SETTING} is {kind}: set it to {found}, or"
            f" remove {path.name} and {certificate_file} to start with a new authority (every host enrols again)"
        )
    if passphrase is not None and not encrypted:
        write_key(path, key, passphrase)
    return key


def _decode(path: Path, data: bytes, passphrase: bytes | None, *, encrypted: bool) -> Key:
    if encrypted and passphrase is None:
        raise SignerKeyError(
            f"{path} is encrypted: name the file that has its passphrase by {PASSPHRASE_SETTING} or"
            " ROSRV_CA_PASSPHRASE_FILE"
        )
    try:
        key = load_pem_private_key(data, password=passphrase)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        if encrypted:
            raise SignerKeyError(
                f"{path} cannot be decrypted: the passphrase is wrong, or the file is damaged; correct the file that"
                f" {PASSPHRASE_SETTING} names, or restore the key from a backup"
            ) from error
        raise SignerKeyError(
            f"{path}: not a private key in PEM: {error}; restore it from a backup"
        ) from error
    if not isinstance(key, Key):
        raise SignerKeyError(f"{path}: neither an ECDSA key nor an Ed25519 key; restore it from a backup")
    return key


def _kind(path: Path, key: Key) -> Kind:
    if isinstance(key, ed25519.Ed25519PrivateKey):
        return "ed25519"
    if not isinstance(key.curve, ec.SECP384R1):
        raise SignerKeyError(f"{path}: an ECDSA key, but not on P-384; restore it from a backup")
    return "ecdsa"
