"""Write and parse the statements about the audit log that the signer signs: checkpoints and removals. No I/O.

Invariants:
1. A checkpoint contains the log's id, its own number, the sequence, the hash at that sequence, the time, and the hash
   of the previous checkpoint. From version 2 on, it also contains the last removed record.
2. A removal names the last checkpoint of the removed records, and the limit in the settings that required the removal.
3. Each statement has exactly one valid text. Any other spelling, such as a leading zero, is invalid.
"""

import hashlib
import re
from typing import NamedTuple

NO_CHECKPOINT = "0" * 64  # the hash before the first checkpoint


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


_CHECKPOINT = re.compile(
    rb"rosrv audit checkpoint [12]\nlog ([0-9a-f]{32})\nnumber (\d{1,18}+)\nsequence (\d{1,18}+)\n"
    rb"hash ([0-9a-f]{64})\ntime (\d{1,19}+)\nprevious ([0-9a-f]{64})\n(?:removed (\d{1,18}+)\n)?"
)


def parse_checkpoint(text: bytes) -> Checkpoint:
    """Parse the text of a checkpoint. Raises `ValueError` for any other text."""
    match = _CHECKPOINT.fullmatch(text)
    if match is not None:
        log, number, sequence, digest, time, previous = (group.decode() for group in match.groups()[:6])
        removed = None if match[7] is None else int(match[7])
        found = Checkpoint(log, int(number), int(sequence), digest, int(time), previous, removed)
        if found.text() == text:
            return found
    raise ValueError("not the text of an audit checkpoint")


def checkpoint_hash(text: bytes) -> str:
    """Return the hash of a checkpoint, which the next checkpoint stores as `previous`."""
    return hashlib.sha256(text).hexdigest()


class Removal(NamedTuple):
    """A removal of all records up to a checkpoint.

    The fields are the checkpoint's number, its sequence, the record's hash there, and the checkpoint's own hash
    (`sealed`). `limit` is the setting that required the removal, as the signer writes it.
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


_LIMIT = re.compile(rb"\nlimit ([0-9][0-9.e+-]{0,31}+ (?:days|bytes))\n\Z")


def limit_of_removal(text: bytes) -> str:
    """Return the limit in the text of a removal, or raise `ValueError`."""
    match = _LIMIT.search(text)
    if match is None:
        raise ValueError("not the text of a removal")
    return match[1].decode()
