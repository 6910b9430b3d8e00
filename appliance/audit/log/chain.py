"""Compute the hash chain. No I/O.

Invariants:
1. The hash of a record covers the hash of its columns (`content_hash`) and the hash of the previous record. An export
   can therefore prove the chain without the records that it omits. Version 0.1.0 hashed the columns directly.
2. The encoding is injective: a MessagePack array, in which every value is stored with its type and length.
"""

import hashlib
from typing import NamedTuple

import msgspec

_encoder = msgspec.msgpack.Encoder()


class StoredColumns(NamedTuple):
    """The columns of table `record`, in order and without the hash."""

    sequence: int
    id: str
    time: int
    version: int
    event: str
    severity: str
    decision: str | None
    host: str | None
    caller_id: str | None
    category: str | None
    resource: str | None
    rule: str | None
    rule_key: str | None
    rule_file: str | None
    rule_line: int | None
    revision: int | None
    reason: str
    duration_us: int | None
    detail: bytes


def genesis(log_id: str) -> bytes:
    return hashlib.sha256(b"rosrv audit log\n" + log_id.encode()).digest()


def content_hash(columns: tuple[object, ...]) -> bytes:
    """Return the hash of the values of `StoredColumns`, independent of the preceding records."""
    return hashlib.sha256(_encoder.encode(columns)).digest()


def link(previous: bytes, content: bytes) -> bytes:
    """Return the hash of a record with the content hash `content` that follows the hash `previous`."""
    # The input has 65 bytes, so it cannot equal an input of version 0.1.0, which was always longer.
    return hashlib.sha256(previous + b"2" + content).digest()


def record_hash(previous: bytes, columns: tuple[object, ...]) -> bytes:
    return link(previous, content_hash(columns))


def follows(previous: bytes, columns: tuple[object, ...], digest: bytes) -> bool:
    """Return whether `digest` is the hash of this record after `previous`, as this version or 0.1.0 computes it."""
    if record_hash(previous, columns) == digest:
        return True
    return hashlib.sha256(previous + _encoder.encode(columns)).digest() == digest
