"""Holds the checkpoints of a log against its chain, its key, and what others remember of them.

Invariants: a checkpoint is right when its text is well formed and of this log, follows the checkpoint
before it, and names the hash that the chain has at its sequence; it is proven when the expected key signed
it. What the signer signed and the log has no signature of is on its way as long as it is among the last that are asked
for at once (after a crash, or in a copy, it stays so); with signatures after it, or with more of it, it was removed.
"""

import sqlite3
from collections.abc import Iterable, Iterator
from pathlib import Path

import msgspec

from appliance.audit.chain_findings import Kind, LogFinding
from appliance.audit.signatures import ASKED_AT_ONCE, signature_is_right
from appliance.signing.signed_statements import Checkpoint, checkpoint_hash, parse_checkpoint

_HASH = 32
_HEADER = 8
_TYPES = (int, int, bytes, bytes | None, bytes | None)


class Remembered(msgspec.Struct, frozen=True):
    """What the signer remembers of a log: the hashes of the checkpoints it signed, from number `first` on.

    `removed`: up to which record it approved removals; None where it was never asked.
    """

    first: int
    hashes: bytes
    removed: int | None = None

    @property
    def last(self) -> int:
        """The number of the last checkpoint signed."""
        return self.first + len(self.hashes) // _HASH - 1

    def hash(self, number: int) -> str | None:
        """The hash of the checkpoint with this number; None if it is not remembered."""
        at = (number - self.first) * _HASH
        return self.hashes[at : at + _HASH].hex() if self.first <= number <= self.last else None


def read_remembered(directory: Path, log: str) -> Remembered | None:
    """What the signer whose directory this is remembers of a log; None if it never signed one of it."""
    path = directory / f"{log}.signed"
    if not path.exists():
        return None
    data = path.read_bytes()
    removed = directory / f"{log}.removed"
    approved = int.from_bytes(removed.read_bytes(), "big") if removed.exists() else None
    return Remembered(int.from_bytes(data[:_HEADER], "big"), data[_HEADER:], approved)


class CheckpointAudit:
    """Checks checkpoints in order of their numbers against the hashes that the chain has."""

    def __init__(self, log: str, key: bytes | None, remembered: Remembered | None) -> None:
        self._log = log
        self._key = key
        self._remembered = remembered
        self.count = 0
        self.signed = 0
        self.signed_through = 0
        self.last_number = 0
        self.removed: list[int] = []
        """What checkpoints say of how much is removed."""
        self._signed_seen = False
        self._on_their_way: list[int] = []

    def check(
        self,
        rows: Iterable[tuple[int, int, bytes, bytes | None, bytes | None]],
        before: tuple[int, str],
        chain: dict[int, bytes],
        last_sequence: int,
    ) -> Iterator[LogFinding]:
        """Check all rows; `before` is the last checkpoint that retention removed (0 and zeros if none)."""
        number, previous = before
        self.last_number = number
        for row in rows:
            if row[0] != number + 1:
                yield _finding(Kind.CHECKPOINT_MISSING, number + 1, row[0] - 1, "removed from the log")
                previous = ""
            number = self.last_number = row[0]
            self.count += 1
            yield from self._check_row(row, previous, chain, last_sequence)
            previous = checkpoint_hash(row[2])
        if len(self._on_their_way) > ASKED_AT_ONCE:
            yield from self._signatures_removed()
        if self._remembered is not None and self._remembered.last > number:
            yield _finding(
                Kind.CHECKPOINT_MISSING,
                number + 1,
                self._remembered.last,
                "signed by the signer, but not in the log: its end was cut off, or an old copy was put back",
            )
        if self._key is None and self._signed_seen:
            yield LogFinding(
                Kind.NO_KEY, 0, 0, "checkpoints are signed, but there is no key to hold them against"
            )

    def _check_row(
        self,
        row: tuple[int, int, bytes, bytes | None, bytes | None],
        previous: str,
        chain: dict[int, bytes],
        last_sequence: int,
    ) -> Iterator[LogFinding]:
        number, _sequence, text, signature, public_key = row
        self.removed += _removed(text)
        wrong = self._disagreement(row, previous, chain, last_sequence)
        remembered = self._remembered.hash(number) if self._remembered else None
        if wrong is not None:
            yield wrong
        elif remembered is not None and remembered != checkpoint_hash(text):
            yield _finding(Kind.CHECKPOINT_CHANGED, number, number, "not the one that the signer signed")
        elif signature is None and remembered is not None:
            self._on_their_way.append(number)
        if signature is None:
            return
        yield from self._signatures_removed()
        self._signed_seen = True
        if self._key is None:
            return
        if public_key != self._key:
            shown = "no key" if public_key is None else public_key.hex()
            message = f"signed with {shown}, expected is {self._key.hex()}"
            yield _finding(Kind.WRONG_KEY, number, number, message)
        elif not signature_is_right(self._key, signature, text):
            yield _finding(Kind.SIGNATURE_WRONG, number, number, "its signature does not fit it")
        elif wrong is None:
            self.signed += 1
            self.signed_through = row[1]

    def _signatures_removed(self) -> Iterator[LogFinding]:
        numbers, self._on_their_way = self._on_their_way, []
        for number in numbers:
            message = "the signer signed it, its signature was removed"
            yield _finding(Kind.SIGNATURE_MISSING, number, number, message)

    def _disagreement(
        self,
        row: tuple[int, int, bytes, bytes | None, bytes | None],
        previous: str,
        chain: dict[int, bytes],
        last_sequence: int,
    ) -> LogFinding | None:
        number, sequence, text = row[:3]
        try:
            checkpoint = parse_checkpoint(text)
        except ValueError as error:
            return _finding(Kind.CHECKPOINT_CHANGED, number, number, str(error))
        if (checkpoint.log, checkpoint.number, checkpoint.sequence) != (self._log, number, sequence):
            return _finding(
                Kind.CHECKPOINT_CHANGED, number, number, "its text is of another checkpoint or log"
            )
        if previous and checkpoint.previous != previous:
            message = "it does not follow from the checkpoint before it"
            return _finding(Kind.CHECKPOINT_CHANGED, number, number, message)
        return _held_against_chain(checkpoint, chain, last_sequence)


def _removed(text: bytes) -> list[int]:
    """What a checkpoint says of how much is removed; nothing if it does not, or is none."""
    try:
        removed = parse_checkpoint(text).removed
    except ValueError:
        return []
    return [] if removed is None else [removed]


def _held_against_chain(
    checkpoint: Checkpoint, chain: dict[int, bytes], last_sequence: int
) -> LogFinding | None:
    if checkpoint.sequence > last_sequence:
        message = (
            f"records {last_sequence + 1} to {checkpoint.sequence} were removed from the end"
            f" (checkpoint {checkpoint.number} seals them)"
        )
        return LogFinding(Kind.TRUNCATED, last_sequence + 1, checkpoint.sequence, message)
    if checkpoint.sequence and checkpoint.sequence not in chain:
        return None  # the record it seals is missing, which is reported for the record
    if checkpoint.sequence and chain[checkpoint.sequence].hex() != checkpoint.hash:
        message = (
            f"the chain at record {checkpoint.sequence} has another hash than checkpoint {checkpoint.number}:"
            " records up to there were written anew, or the checkpoint was changed"
        )
        return LogFinding(Kind.CHECKPOINT_CHANGED, checkpoint.number, checkpoint.number, message)
    return None


def _finding(kind: Kind, first: int, last: int, message: str) -> LogFinding:
    name = f"checkpoint {first}" if first == last else f"checkpoints {first} to {last}"
    return LogFinding(kind, first, last, f"{name}: {message}")


def checkpoint_rows(
    connection: sqlite3.Connection,
) -> Iterator[tuple[int, int, bytes, bytes | None, bytes | None]]:
    """The rows of table `checkpoint` in order. Raises `sqlite3.DataError` for what is of another type."""
    for row in connection.execute(
        "SELECT number, sequence, text, signature, public_key FROM checkpoint ORDER BY number"
    ):
        if not all(map(isinstance, row, _TYPES)):
            raise sqlite3.DataError("a column has a value of another type than a log's tables hold")
        yield row
