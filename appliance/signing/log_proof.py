"""Decide what the parts of an audit log prove: records, checkpoints, removals. Standard library only, no I/O.

Every verifier of a log decides with this module. The bundle's verifier contains it, and must run on Python 3.8.

1. The hash of a record covers the hash of its columns and the hash of the previous record (`link`), so an excerpt can
   prove the chain without the records that it omits. Version 0.1.0 hashed the columns directly.
2. A checkpoint contains the hash of the previous one, and from version 2 on the last removed record.
3. Each statement has exactly one valid text. Any other spelling, such as a leading zero, is invalid.
"""

from __future__ import annotations

import enum
import hashlib
import re
from typing import Callable, NamedTuple

NO_CHECKPOINT = "0" * 64  # the hash before the first checkpoint
HasSigned = Callable[[bytes, bytes, bytes], bool]
"""Returns whether a key (32 raw bytes) made the signature of the text."""


class ProofFault(enum.Enum):
    """Why the appliance did not write a record or a checkpoint."""

    CHANGED = "a record does not have its hash"
    MOVED = "a record does not follow the one before it"
    LOG = "a checkpoint is of another log"
    CUT_OFF = "the sealed records are missing at the end"
    MISSING = "the sealed record is missing"
    REWRITTEN = "the sealed record has another hash"
    OTHER = "another checkpoint has its number"
    KEY = "another key signed"
    SIGNATURE = "the signature does not fit the text"


def sha256(data: bytes) -> bytes:
    return hashlib.sha256(data).digest()


def genesis(log_id: str) -> bytes:
    return sha256(b"rosrv audit log\n" + log_id.encode())


def link(previous: bytes, content: bytes) -> bytes:
    # The input has 65 bytes, so it cannot equal an input of version 0.1.0, which was always longer.
    return hashlib.sha256(previous + b"2" + content).digest()


def follows(previous: bytes, packed: bytes, digest: bytes) -> bool:
    """Return whether `digest` is the hash of a record after `previous`, as this version or 0.1.0 computes it."""
    return digest == link(previous, sha256(packed)) or digest == sha256(previous + packed)


class Excerpt:
    """A walk along records in ascending order, up to the checkpoints that seal them.

    `begin` is the first record that no checkpoint seals yet, or 0; only then may the next record leave a gap.
    """

    def __init__(self, sequence: int = 0, digest: bytes = b"") -> None:
        self.sequence, self.hash = sequence, digest
        self.begin = sequence + 1 if digest else 0

    def add(self, sequence: int, previous: bytes, packed: bytes, digest: bytes) -> list[ProofFault]:
        changed = not follows(previous, packed, digest)
        is_next = (sequence, previous) == (self.sequence + 1, self.hash)
        moved = self.hash and not is_next and (self.begin or sequence <= self.sequence + 1)
        self.sequence, self.hash, self.begin = sequence, digest, self.begin or sequence
        return [ProofFault.CHANGED] * changed + [ProofFault.MOVED] * bool(moved)

    def skip(self, content: bytes) -> None:
        self.sequence, self.hash = self.sequence + 1, link(self.hash, content)


class Checkpoint(NamedTuple):
    """The state of the chain at one time; `time` is in nanoseconds since the epoch, hashes in hexadecimal."""

    log: str
    number: int
    sequence: int
    hash: str
    time: int
    previous: str
    removed: int | None = None

    def text(self) -> bytes:
        version, removed = (1, "") if self.removed is None else (2, f"removed {self.removed}\n")
        return (
            f"rosrv audit checkpoint {version}\nlog {self.log}\nnumber {self.number}\nsequence {self.sequence}\n"
            f"hash {self.hash}\ntime {self.time}\nprevious {self.previous}\n{removed}"
        ).encode()

    def follows(self, before: Checkpoint | None) -> bool:
        """Return whether this checkpoint comes next after `before`; None stands for the beginning of the log."""
        if before is None:
            return (self.number, self.previous) == (1, NO_CHECKPOINT)
        expected = (before.log, before.number + 1, checkpoint_hash(before.text()))
        return (self.log, self.number, self.previous) == expected and before.sequence <= self.sequence

    def contradiction(self, last: int, here: bytes | None) -> ProofFault | None:
        """Compare with a chain that ends with record `last`, and has the hash `here` at this sequence (None: none)."""
        if self.sequence > last:
            return ProofFault.CUT_OFF
        if here is None:
            return ProofFault.MISSING
        return None if here.hex() == self.hash else ProofFault.REWRITTEN


_CHECKPOINT = re.compile(
    r"rosrv audit checkpoint [12]\nlog ([0-9a-f]{32})\nnumber ([0-9]{1,18})\nsequence ([0-9]{1,18})\n"
    r"hash ([0-9a-f]{64})\ntime ([0-9]{1,19})\nprevious ([0-9a-f]{64})\n(?:removed ([0-9]{1,18})\n)?"
)


def parse_checkpoint(text: bytes) -> Checkpoint:
    """Return the checkpoint in a text. Raises `ValueError` for any other text."""
    match = _CHECKPOINT.fullmatch(text.decode("ascii", "replace"))
    if match is not None:
        log, number, sequence, digest, time, previous, last = match.groups()
        removed = None if last is None else int(last)
        checkpoint = Checkpoint(log, int(number), int(sequence), digest, int(time), previous, removed)
        if checkpoint.text() == text:
            return checkpoint
    raise ValueError("not the text of an audit checkpoint")


def checkpoint_hash(text: bytes) -> str:
    return sha256(text).hex()


def signature_fault(
    text: bytes, signature: str, key: str | None, expected: str, has_signed: HasSigned
) -> ProofFault | None:
    """Return why the key `expected` did not sign the statement. All but the text is in hexadecimal."""
    if key != expected:
        return ProofFault.KEY
    try:
        made, signer = bytes.fromhex(signature), bytes.fromhex(expected)
    except ValueError:
        return ProofFault.SIGNATURE
    return None if made.hex() == signature and has_signed(signer, made, text) else ProofFault.SIGNATURE


class Removal(NamedTuple):
    """A removal of all records up to a checkpoint.

    `sealed` is the checkpoint's own hash. `limit` is the setting that required it, as the signer writes it.
    """

    log: str
    checkpoint: int
    sequence: int
    hash: str
    sealed: str
    limit: str

    def text(self) -> bytes:
        return (
            f"rosrv audit removal 1\nlog {self.log}\ncheckpoint {self.checkpoint}\nsequence {self.sequence}\n"
            f"hash {self.hash}\nsealed {self.sealed}\nlimit {self.limit}\n"
        ).encode()
