"""Read what the signer remembers of a log, with which a log is compared that someone may have rewritten."""

import os
from pathlib import Path

import msgspec

from appliance.base.owner_access import open_named

_HASH = 32
_HEADER = 8


class SignerMemory(msgspec.Struct, frozen=True):
    """The hashes of the checkpoints that the signer signed, from number `first` on, and the last approved removal."""

    first: int = 1
    hashes: bytes = b""
    removed: int | None = None

    @property
    def last(self) -> int:
        return self.first + len(self.hashes) // _HASH - 1

    def hash(self, number: int) -> str | None:
        at = (number - self.first) * _HASH
        return self.hashes[at : at + _HASH].hex() if self.first <= number <= self.last else None


def read_signer_memory(directory: Path, log: str) -> SignerMemory | None:
    """Return what the signer remembers of the log; None without the folder, or the right to read it."""
    try:
        signed, removed = (_remembered(directory / f"{log}.{what}") for what in ("signed", "removed"))
    except PermissionError:
        return None
    if signed is None:
        return SignerMemory() if directory.is_dir() else None
    approved = None if removed is None else int.from_bytes(removed, "big")
    return SignerMemory(int.from_bytes(signed[:_HEADER], "big"), signed[_HEADER:], approved)


def _remembered(path: Path) -> bytes | None:
    try:
        with os.fdopen(open_named(path), "rb") as file:  # in a container, root reads it as the signer
            return file.read()
    except FileNotFoundError:
        return None
