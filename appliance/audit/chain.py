"""The hash chain: what exactly is hashed, and what exactly is signed. No I/O.

Invariants:
1. Every column of a stored record goes into its hash, and so does the hash of the record before it. The columns go in
   by their own hash (`content_hash`), so that an export shows the chain without the records that it leaves out.
   Version 0.1.0 hashed the columns themselves; its records are right as they are.
2. The encoding is injective: MessagePack of one array, in which every value carries its type and length.
3. A checkpoint names the log, its own number, the sequence, the hash at that
   sequence, the time, the hash of the checkpoint before it, and up to which record the log's beginning is removed;
   those lines are what is signed. Checkpoints of version 1 do not say what is removed.
4. A removal names the checkpoint up to which records go and the limit of the settings that it follows from; that is
   signed.
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


class Checkpoint(NamedTuple):
    """The state of the chain at one moment; `time` in nanoseconds since the epoch, hashes in hexadecimal."""

    log: str
    number: int
    sequence: int
    hash: str
    time: int
    previous: str
    removed: int | None = None

    def text(self) -> bytes:
        """What is signed."""
        version, removed = (1, "") if self.removed is None else (2, f"removed {self.removed}\n")
        return (
            f"rosrv audit checkpoint {version}\nlog {self.log}\nnumber {self.number}\nsequence {self.sequence}\n"
            f"hash {self.hash}\ntime {self.time}\nprevious {self.previous}\n{removed}"
        ).encode()


_CHECKPOINT = re.compile(
    rb"rosrv audit checkpoint ([12])\nlog ([0-9a-f]{32})\nnumber (\d{1,18})\nsequence (\d{1,18})\n"
    rb"hash ([0-9a-f]{64})\ntime (\d{1,19})\nprevious ([0-9a-f]{64})\n(?:removed (\d{1,18})\n)?"
)


def parse_checkpoint(text: bytes) -> Checkpoint:
    """Read a checkpoint's text. Raises `ValueError` for anything that is not exactly one."""
    match = _CHECKPOINT.fullmatch(text)
    if match is None or (match[1] == b"2") is not (match[8] is not None):
        raise ValueError("not the text of an audit checkpoint")
    log, number, sequence, digest, time, previous = (group.decode() for group in match.groups()[1:7])
    removed = None if match[8] is None else int(match[8])
    return Checkpoint(log, int(number), int(sequence), digest, int(time), previous, removed)


def checkpoint_hash(text: bytes) -> str:
    """The hash that the next checkpoint carries as `previous`."""
    return hashlib.sha256(text).hexdigest()


class Removal(NamedTuple):
    """The removal of all records up to a checkpoint: its number, sequence, the hash there, and its own hash.

    `limit` is the setting that it follows from, as the signer writes it.
    """

    log: str
    checkpoint: int
    sequence: int
    hash: str
    sealed: str
    limit: str

    def text(self) -> bytes:
        """What is signed."""
        return (
            f"rosrv audit removal 1\nlog {self.log}\ncheckpoint {self.checkpoint}\nsequence {self.sequence}\n"
            f"hash {self.hash}\nsealed {self.sealed}\nlimit {self.limit}\n"
        ).encode()


_LIMIT = re.compile(rb"\nlimit ([0-9][0-9.e+-]{0,31} (?:days|bytes))\n\Z")


def limit_of_removal(text: bytes) -> str:
    """The limit in a removal's text. Raises `ValueError` where there is none."""
    match = _LIMIT.search(text)
    if match is None:
        raise ValueError("not the text of a removal")
    return match[1].decode()
