"""Read what the signer remembers of a log, with which a log is compared that someone may have rewritten or replaced."""

import os
from pathlib import Path

import msgspec

from appliance.audit.log.signatures import parse_public_key
from appliance.base.owner_access import open_named
from appliance.signing.signed_logs import (
    HASH_BYTES,
    HEADER_BYTES,
    OtherLog,
    RememberedLog,
    others,
    remembered_logs,
)

_PUBLIC_KEY = "audit.pub"  # beside the key of a signer that has run


class SignerMemory(msgspec.Struct, frozen=True):
    """The hashes of the checkpoints that the signer signed, from number `first` on, and the last approved removal.

    `others` are the logs that it signed besides this one. `lost`: the memory, or its beginning, was removed. `key` is
    the signer's public key (raw), if it has one.
    """

    first: int = 1
    hashes: bytes = b""
    removed: int | None = None
    others: list[OtherLog] = []
    lost: bool = False
    key: bytes | None = None

    @property
    def last(self) -> int:
        return self.first + len(self.hashes) // HASH_BYTES - 1

    def hash(self, number: int) -> str | None:
        at = (number - self.first) * HASH_BYTES
        return self.hashes[at : at + HASH_BYTES].hex() if self.first <= number <= self.last else None


def read_signer_memory(directory: Path, log: str) -> SignerMemory | None:
    """Return what the signer remembers of the log; None without the folder, or the right to read it.

    Raises `OSError`, and `ValueError` for a damaged file, and `KeyUnreadableError` for one that has no key.
    """
    try:
        logs = remembered_logs(directory, open_named)
        signed, removed = (_remembered(directory / f"{log}.{what}") for what in ("signed", "removed"))
        pem = _remembered(directory / _PUBLIC_KEY)
    except (FileNotFoundError, PermissionError):
        return None
    key = None if pem is None else parse_public_key(pem, directory / _PUBLIC_KEY)
    own = next((one for one in logs if one.log == log), None)
    beside = others(logs, log)
    if signed is None:
        lost = key is not None and (own is None or own.lacks_memory)
        return SignerMemory(others=beside, lost=lost, key=key)
    removed_to = None if removed is None else int.from_bytes(removed, "big")
    first = int.from_bytes(signed[:HEADER_BYTES], "big")
    return SignerMemory(first, signed[HEADER_BYTES:], removed_to, beside, _is_cut(own), key)


def _is_cut(own: RememberedLog | None) -> bool:
    return own is not None and own.lacks_memory


def _remembered(path: Path) -> bytes | None:
    try:
        with os.fdopen(open_named(path), "rb") as file:  # in a container, root reads it as the signer
            return file.read()
    except FileNotFoundError:
        return None
