"""Verify the checkpoints of a log, using the log's chain, the key, and the signer's memory.

A checkpoint is valid if its text is well formed and belongs to this log, it follows the previous checkpoint, and it has
the chain's hash at its sequence. A checkpoint is proven if the expected key signed it. A signature that the signer
remembers may be missing because it is pending, but only for the last `ASKED_AT_ONCE` checkpoints. Otherwise the
signature was removed.
"""

import sqlite3
from collections.abc import Iterable, Iterator
from pathlib import Path

import msgspec

from appliance.audit.log.signatures import ASKED_AT_ONCE, signature_is_valid
from appliance.audit.proof.chain_findings import FindingKind, LogFinding
from appliance.signing.signed_statements import Checkpoint, checkpoint_hash, parse_checkpoint

_HASH = 32
_HEADER = 8
_TYPES = (int, int, bytes, bytes | None, bytes | None)


class SignerMemory(msgspec.Struct, frozen=True):
    """The signer's memory of a log: the hashes of the checkpoints that it signed, from number `first` on.

    `removed` is the last record whose removal it approved; None if it never approved one.
    """

    first: int
    hashes: bytes
    removed: int | None = None

    @property
    def last(self) -> int:
        return self.first + len(self.hashes) // _HASH - 1

    def hash(self, number: int) -> str | None:
        at = (number - self.first) * _HASH
        return self.hashes[at : at + _HASH].hex() if self.first <= number <= self.last else None


def read_signer_memory(directory: Path, log: str) -> SignerMemory | None:
    """Return the signer's memory of a log from `directory`, or None if the signer never signed a checkpoint of it."""
    path = directory / f"{log}.signed"
    if not path.exists():
        return None
    data = path.read_bytes()
    removed = directory / f"{log}.removed"
    approved = int.from_bytes(removed.read_bytes(), "big") if removed.exists() else None
    return SignerMemory(int.from_bytes(data[:_HEADER], "big"), data[_HEADER:], approved)


class CheckpointVerifier:
    """Verifies checkpoints, in order, against the hashes of the chain."""

    def __init__(self, log: str, key: bytes | None, remembered: SignerMemory | None) -> None:
        self._log = log
        self._key = key
        self._remembered = remembered
        self.count = 0
        self.signed = 0
        self.signed_through = 0
        self.last_number = 0
        self.removed: list[int] = []
        """The values of `removed` in checkpoints."""
        self._signed_seen = False
        self._on_their_way: list[int] = []

    def check(
        self,
        rows: Iterable[tuple[int, int, bytes, bytes | None, bytes | None]],
        before: tuple[int, str],
        chain: dict[int, bytes],
        last_sequence: int,
    ) -> Iterator[LogFinding]:
        """Yield the findings; `before` is the last checkpoint that retention removed: number and hash, or zeros."""
        number, previous = before
        self.last_number = number
        for row in rows:
            if row[0] != number + 1:
                yield _finding(FindingKind.CHECKPOINT_MISSING, number + 1, row[0] - 1, "removed from the log")
                previous = ""
            number = self.last_number = row[0]
            self.count += 1
            yield from self._check_row(row, previous, chain, last_sequence)
            previous = checkpoint_hash(row[2])
        if len(self._on_their_way) > ASKED_AT_ONCE:
            yield from self._signatures_removed()
        if self._remembered is not None and self._remembered.last > number:
            yield _finding(
                FindingKind.CHECKPOINT_MISSING,
                number + 1,
                self._remembered.last,
                "signed by the signer, but not in the log: its end was cut off, or an old copy was restored",
            )
        if self._key is None and self._signed_seen:
            yield LogFinding(
                FindingKind.NO_KEY, 0, 0, "checkpoints are signed, but there is no key to verify them with"
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
            yield _finding(
                FindingKind.CHECKPOINT_CHANGED, number, number, "not the one that the signer signed"
            )
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
            yield _finding(FindingKind.WRONG_KEY, number, number, message)
        elif not signature_is_valid(self._key, signature, text):
            yield _finding(FindingKind.SIGNATURE_WRONG, number, number, "its signature does not fit it")
        elif wrong is None:
            self.signed += 1
            self.signed_through = row[1]

    def _signatures_removed(self) -> Iterator[LogFinding]:
        numbers, self._on_their_way = self._on_their_way, []
        for number in numbers:
            message = "the signer signed it, its signature was removed"
            yield _finding(FindingKind.SIGNATURE_MISSING, number, number, message)

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
            return _finding(FindingKind.CHECKPOINT_CHANGED, number, number, str(error))
        if (checkpoint.log, checkpoint.number, checkpoint.sequence) != (self._log, number, sequence):
            return _finding(
                FindingKind.CHECKPOINT_CHANGED, number, number, "its text is of another checkpoint or log"
            )
        if previous and checkpoint.previous != previous:
            message = "it does not follow from the checkpoint before it"
            return _finding(FindingKind.CHECKPOINT_CHANGED, number, number, message)
        return _held_against_chain(checkpoint, chain, last_sequence)


def _removed(text: bytes) -> list[int]:
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
        return LogFinding(FindingKind.TRUNCATED, last_sequence + 1, checkpoint.sequence, message)
    if checkpoint.sequence and checkpoint.sequence not in chain:
        return None  # the sealed record is missing; the finding about that record reports it
    if checkpoint.sequence and chain[checkpoint.sequence].hex() != checkpoint.hash:
        message = (
            f"the chain at record {checkpoint.sequence} has another hash than checkpoint {checkpoint.number}:"
            " records up to there were rewritten, or the checkpoint was changed"
        )
        return LogFinding(FindingKind.CHECKPOINT_CHANGED, checkpoint.number, checkpoint.number, message)
    return None


def _finding(kind: FindingKind, first: int, last: int, message: str) -> LogFinding:
    name = f"checkpoint {first}" if first == last else f"checkpoints {first} to {last}"
    return LogFinding(kind, first, last, f"{name}: {message}")


def checkpoint_rows(
    connection: sqlite3.Connection,
) -> Iterator[tuple[int, int, bytes, bytes | None, bytes | None]]:
    """Yield the rows of table `checkpoint` in order. Raises `sqlite3.DataError` for a value of another type."""
    for row in connection.execute(
        "SELECT number, sequence, text, signature, public_key FROM checkpoint ORDER BY number"
    ):
        if not all(map(isinstance, row, _TYPES)):
            raise sqlite3.DataError("a column has a value of another type than a log's tables hold")
        yield row
