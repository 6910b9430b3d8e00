"""The hash chain: what exactly is hashed, and what exactly is signed. No I/O.

Invariants:
1. Every column of a stored record goes into its hash, and so does the hash of the record before it.
2. The encoding is injective: MessagePack of one array, in which every value carries its type and length.
3. A checkpoint names the log, its own number, the sequence, the hash at that
   sequence, the time and the hash of the checkpoint before it; those lines are what is signed.
"""

import hashlib
import re
from typing import NamedTuple

import msgspec

HASH_SIZE = 32
NO_CHECKPOINT = "0" * (2 * HASH_SIZE)
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


def record_hash(previous: bytes, columns: tuple[object, ...]) -> bytes:
    """The hash of a stored record (`StoredColumns` values) that follows the hash `previous`."""
    return hashlib.sha256(previous + _encoder.encode(columns)).digest()


class Checkpoint(NamedTuple):
    """The state of the chain at one moment; `time` in nanoseconds since the epoch, hashes in hexadecimal."""

    log: str
    number: int
    sequence: int
    hash: str
    time: int
    previous: str

    def text(self) -> bytes:
        """What is signed."""
        return (
            f"rosrv audit checkpoint 1\nlog {self.log}\nnumber {self.number}\nsequence {self.sequence}\n"
            f"hash {self.hash}\ntime {self.time}\nprevious {self.previous}\n"
        ).encode()


_CHECKPOINT = re.compile(
    rb"rosrv audit checkpoint 1\nlog ([0-9a-f]{32})\nnumber (\d{1,18})\nsequence (\d{1,18})\n"
    rb"hash ([0-9a-f]{64})\ntime (\d{1,19})\nprevious ([0-9a-f]{64})\n"
)


def parse_checkpoint(text: bytes) -> Checkpoint:
    """Read a checkpoint's text. Raises `ValueError` for anything that is not exactly one."""
    match = _CHECKPOINT.fullmatch(text)
    if match is None:
        raise ValueError("not the text of an audit checkpoint")
    log, number, sequence, digest, time, previous = (group.decode() for group in match.groups())
    return Checkpoint(log, int(number), int(sequence), digest, int(time), previous)


def checkpoint_hash(text: bytes) -> str:
    """The hash that the next checkpoint carries as `previous`."""
    return hashlib.sha256(text).hexdigest()
