"""Verify the checkpoints of a log, using the log's chain, the key, and the signer's memory.

A checkpoint is valid if it follows the previous one and has the chain's hash, and proven if the expected key signed
it. If the signer remembers a signature that the log lacks, it was removed, except among the last `ASKED_AT_ONCE`,
which may be under way.
"""

import os
import sqlite3
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec

from appliance.audit.log.log_queries import last_detail
from appliance.audit.log.retention import RemovedRange
from appliance.audit.log.signatures import ASKED_AT_ONCE, parse_public_key, signature_is_valid
from appliance.audit.proof.chain_findings import FindingKind, LogFinding
from appliance.base.owner_access import open_named
from appliance.signing.log_proof import ProofFault, checkpoint_hash, parse_checkpoint, signature_fault
from appliance.signing.signed_logs import (
    HASH_BYTES,
    HEADER_BYTES,
    OtherLog,
    RememberedLog,
    others,
    remembered_logs,
)

# Read what the signer remembers of a log, with which a log is compared that someone may have rewritten or replaced.

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
        emptied = key is None and not beside  # a signer that signed has memory and key
        lost = (key is not None or emptied) and (own is None or own.lacks_memory)
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


_TYPES = (int, int, bytes, bytes | None, bytes | None)
_ROWS = "SELECT number, sequence, text, signature, public_key FROM checkpoint ORDER BY number LIMIT ?"


class StoredCheckpoint(NamedTuple):
    """A row of table `checkpoint`."""

    number: int
    sequence: int
    text: bytes
    signature: bytes | None
    public_key: bytes | None


def last_removal(connection: sqlite3.Connection) -> RemovedRange | None:
    """Return the last removal on record, or None. Raises the errors of `msgspec` for a damaged record."""
    detail = last_detail(connection, "records removed")
    return None if detail is None else msgspec.json.decode(detail, type=RemovedRange)


class CheckpointVerifier:
    """Verifies checkpoints, in order, against the hashes of the chain."""

    def __init__(self, log: str, key: bytes | None, remembered: SignerMemory | None) -> None:
        self._log = log
        self._key = key
        self.remembered = None if remembered is None else remembered.last
        """The last checkpoint in the signer's memory; None if that was not read."""
        self._remembered = remembered = remembered or SignerMemory()
        self.other_logs = remembered.others
        self.signed = 0
        self.signed_through = 0
        self.count = 0
        """The number of stored checkpoints: half a million in a year, so they are read twice and not kept."""
        self.sequences: set[int] = set()
        self._connection: sqlite3.Connection | None = None
        self.removed = [] if remembered.removed is None else [remembered.removed]
        """The values of `removed` in the signer's memory and in checkpoints."""
        self._signature_missing: list[int] = []
        """The checkpoints that the signer signed, and that have no signature; the last ones may be under way."""

    def read(self, connection: sqlite3.Connection) -> None:
        """Read all checkpoints of a snapshot. Raises `sqlite3.DatabaseError` after the readable ones."""
        self._connection = connection
        for row in connection.execute(_ROWS, (-1,)):
            if not all(map(isinstance, row, _TYPES)):
                raise sqlite3.DataError("a column has a value of another type than a log's tables hold")
            self.count += 1
            self.sequences.add(row[1])

    def rows(self) -> Iterator[StoredCheckpoint]:
        """Yield the readable checkpoints again."""
        if self._connection is not None and self.count:
            yield from map(StoredCheckpoint._make, self._connection.execute(_ROWS, (self.count,)))

    def check(
        self, removed: RemovedRange, chain: dict[int, bytes], last: int, reported: Iterable[int]
    ) -> Iterator[LogFinding]:
        """Yield the faults; `reported` are the numbers of checkpoints that have a record in the chain."""
        number, previous = removed.last_checkpoint, removed.last_checkpoint_hash
        last_signed = 0
        for row in self.rows():
            if row.signature is not None:
                last_signed = max(last_signed, row.number)
            if row.number != number + 1:
                message = "removed from the log"
                yield _finding(FindingKind.CHECKPOINT_MISSING, number + 1, message, row.number - 1)
                previous = ""
            number = row.number
            yield from self._check_row(row, previous, chain, last)
            previous = checkpoint_hash(row.text)
        many = sum(missing > last_signed for missing in self._signature_missing) > ASKED_AT_ONCE
        for missing in self._signature_missing:
            if many or missing < last_signed:
                message = "the signer signed it, its signature was removed"
                yield _finding(FindingKind.SIGNATURE_MISSING, missing, message)
        if self._remembered.last > number:
            message = (
                "signed by the signer, but not in the log: its end was cut off, or an old copy was restored"
            )
            yield _finding(FindingKind.CHECKPOINT_MISSING, number + 1, message, self._remembered.last)
        if self._key is None and last_signed:
            yield LogFinding(
                FindingKind.NO_KEY, 0, 0, "checkpoints are signed, but there is no key to verify them with"
            )
        for missing in sorted(one for one in reported if one > number):
            message = "the chain has its record, but it was removed"
            yield _finding(FindingKind.CHECKPOINT_MISSING, missing, message)
        yield from self._beside(last_signed)

    def _beside(self, last_signed: int) -> Iterator[LogFinding]:
        signer = self._remembered.key
        if last_signed and self._key is not None and signer not in (None, self._key):
            message = (
                f"the checkpoints are verified with {self._key.hex()}, and the signer's key is {signer.hex()}: the key"
                " beside the log, or the signer's, was replaced"
            )
            yield LogFinding(FindingKind.WRONG_KEY, 0, 0, message)
        for other in self._remembered.others:
            if other.set_aside is None:
                message = (
                    f"the signer signed log {other.log} up to checkpoint {other.last}, and this is log {self._log}: the"
                    " log was replaced or moved away. If you know why, run as root on the machine 'rosrv audit"
                    f" acknowledge {other.log}'"
                )
                yield LogFinding(FindingKind.LOG_REPLACED, 0, 0, message)
        if self._remembered.lost and last_signed:
            message = (
                "the signer's memory of this log, or its beginning, was removed: what it does not have is proven by"
                " signatures only. If you know why, run as root on the machine 'rosrv audit acknowledge"
                f" {self._log}'"
            )
            yield LogFinding(FindingKind.MEMORY_MISSING, 0, 0, message)

    def _check_row(
        self, row: StoredCheckpoint, previous: str, chain: dict[int, bytes], last_sequence: int
    ) -> Iterator[LogFinding]:
        number, _sequence, text, signature, public_key = row
        wrong = self._disagreement(row, previous, chain, last_sequence)
        remembered = self._remembered.hash(number)
        if wrong is not None:
            yield wrong
        elif remembered is not None and remembered != checkpoint_hash(text):
            yield _finding(FindingKind.CHECKPOINT_CHANGED, number, "not the one that the signer signed")
        elif signature is None and remembered is not None:
            self._signature_missing.append(number)
        if signature is None or self._key is None:
            return
        key, expected = None if public_key is None else public_key.hex(), self._key.hex()
        match signature_fault(text, signature.hex(), key, expected, signature_is_valid):
            case ProofFault.KEY:
                message = f"signed with {key or 'no key'}, expected is {expected}"
                yield _finding(FindingKind.WRONG_KEY, number, message)
            case ProofFault.SIGNATURE:
                yield _finding(FindingKind.SIGNATURE_WRONG, number, "its signature does not fit it")
            case _ if wrong is None:
                self.signed += 1
                self.signed_through = row.sequence

    def _disagreement(
        self, row: StoredCheckpoint, previous: str, chain: dict[int, bytes], last_sequence: int
    ) -> LogFinding | None:
        number, wrong = row.number, FindingKind.CHECKPOINT_CHANGED
        try:
            checkpoint = parse_checkpoint(row.text)
        except ValueError as error:
            return _finding(wrong, number, str(error))
        self.removed += [] if checkpoint.removed is None else [checkpoint.removed]
        if (checkpoint.log, checkpoint.number, checkpoint.sequence) != (self._log, number, row.sequence):
            return _finding(wrong, number, "its text is of another checkpoint or log")
        if previous and checkpoint.previous != previous:
            return _finding(wrong, number, "it does not follow from the checkpoint before it")
        # The finding about a missing record reports that record.
        match checkpoint.contradiction(last_sequence, chain.get(row.sequence)):
            case ProofFault.CUT_OFF:
                message = (
                    f"records {last_sequence + 1} to {row.sequence} were removed from the end"
                    f" (checkpoint {number} seals them)"
                )
                return LogFinding(FindingKind.TRUNCATED, last_sequence + 1, row.sequence, message)
            case ProofFault.REWRITTEN:
                message = (
                    f"the chain at record {row.sequence} has another hash than checkpoint {number}:"
                    " records up to there were rewritten, or the checkpoint was changed"
                )
                return LogFinding(wrong, number, number, message)
        return None


def _finding(kind: FindingKind, first: int, message: str, last: int = 0) -> LogFinding:
    last = last or first
    name = f"checkpoint {first}" if first == last else f"checkpoints {first} to {last}"
    return LogFinding(kind, first, last, f"{name}: {message}")
