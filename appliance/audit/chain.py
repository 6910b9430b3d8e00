"""The hash chain: what exactly is hashed. No I/O.

Invariants:
1. Every column of a stored record goes into its hash, and so does the hash of the record before it. The columns go in
   by their own hash (`content_hash`), so that an export shows the chain without the records that it leaves out.
   Version 0.1.0 hashed the columns themselves; its records are right as they are.
2. The encoding is injective: MessagePack of one array, in which every value carries its type and length.
"""

import hashlib
from typing import NamedTuple

import msgspec

_encoder = msgspec.msgpack.Encoder()


class StoredColumns(NamedTuple):
    """A record as it is stored: the columns of table `record`, in their order, without the hash."""

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
    """The hash that stands before the first record of a log."""
    return hashlib.sha256(b"rosrv audit log\n" + log_id.encode()).digest()


def content_hash(columns: tuple[object, ...]) -> bytes:
    """The hash of what a stored record (`StoredColumns` values) holds, wherever it stands."""
    return hashlib.sha256(_encoder.encode(columns)).digest()


def link(previous: bytes, content: bytes) -> bytes:
    """The hash of the record with this content hash that follows the hash `previous`."""
    # 65 bytes; what version 0.1.0 hashed is longer.
    return hashlib.sha256(previous + b"2" + content).digest()


def record_hash(previous: bytes, columns: tuple[object, ...]) -> bytes:
    """The hash of a stored record (`StoredColumns` values) that follows the hash `previous`."""
    return link(previous, content_hash(columns))


def follows(previous: bytes, columns: tuple[object, ...], digest: bytes) -> bool:
    """Whether `digest` is the hash of this record after the hash `previous`, as this version or 0.1.0 made it."""
    if record_hash(previous, columns) == digest:
        return True
    return hashlib.sha256(previous + _encoder.encode(columns)).digest() == digest
