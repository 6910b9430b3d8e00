"""Verify that a log is complete and unchanged, or report which records are missing or changed, and how.

If a record does not follow from the previous one, the verifier tries the next records in other positions, to tell a
change from a removal, an insertion and a reordering. The log alone cannot show whether records after the last signed
checkpoint were cut off or rewritten.
"""

import re
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import msgspec

from appliance.audit.log import log_database
from appliance.audit.log.columns import StoredColumns, follows
from appliance.audit.log.log_database import LogUnreadableError, reading
from appliance.audit.log.retention import RemovedRange
from appliance.audit.log.signatures import pinned_key_path, read_public_key, signature_is_valid
from appliance.audit.proof.chain_findings import FindingKind, LogFinding, Verification
from appliance.audit.proof.checkpoints import (
    CheckpointVerifier,
    SignerMemory,
    last_removal,
    read_signer_memory,
)
from appliance.audit.proof.copies import CopiesVerifier, SignedCheckpoint
from appliance.base import clock
from appliance.base.counted import counted
from appliance.signing.log_proof import NO_CHECKPOINT, genesis, signature_fault

_WINDOW = 64
_TOLD_EVERY = 5000
_MAX_FINDINGS = 1000
_EVENT, _DETAIL = StoredColumns._fields.index("event"), StoredColumns._fields.index("detail")
# The distances by which a record may have been renumbered.
_DISTANCES = (0, *(distance for step in range(1, 1000) for distance in (step, -step)))
_WORDS_TABLES = ("words_data", "words_idx", "words_docsize", "words_config")
_LOG_ID = re.compile("[0-9a-f]{32}")
_Count = Annotated[int, msgspec.Meta(ge=0)]

# A database whose pages name each other again and again has rows for years. This is a tenth of a slow disk's speed.
_LEAST_SECONDS, _LEAST_BYTES_A_SECOND = 600.0, 100_000
_STEPS_BETWEEN_LOOKS = 1_000_000

_NOT_AS_WRITTEN = (TypeError, ValueError, RecursionError, MemoryError)


class _Reported(msgspec.Struct, frozen=True):
    """The required detail of a `checkpoint` record."""

    number: _Count
    hash: str


def verify(
    path: Path,
    public_key: bytes | None = None,
    signer: Path | None = None,
    copies: Sequence[SignedCheckpoint] | None = None,
    progress: Callable[[int], None] = lambda _sequence: None,
) -> Verification:
    """Verify the log at `path`. Raises `LogUnreadableError` and `KeyUnreadableError`.

    `public_key` (raw) must have signed the checkpoints, by default the key beside the log. `signer` is the directory
    with the signer's memory, and `copies` are from another machine.
    """
    with reading(path, advice="") as connection:
        connection.text_factory = lambda text: text.decode("utf-8", "surrogateescape")
        until = clock.now() + _LEAST_SECONDS + path.stat().st_size / _LEAST_BYTES_A_SECOND
        connection.set_progress_handler(lambda: clock.now() > until, _STEPS_BETWEEN_LOOKS)
        log = _log_id(connection)
        # Read the memory before the log, so that a checkpoint signed in between is at most in the log.
        remembered = None if signer is None else _memory(signer, log)
        connection.execute("BEGIN").execute("SELECT count(*) FROM sqlite_schema")  # the log as it is now
        # A key is pinned before its first signature is stored: read it after that.
        if public_key is None and pinned_key_path(path).exists():
            public_key = read_public_key(pinned_key_path(path))
        verifier = _Verifier(connection, log, public_key, remembered, copies=copies, progress=progress)
        return verifier.run()


def _memory(signer: Path, log: str) -> SignerMemory | None:
    try:
        return read_signer_memory(signer, log)
    except (OSError, ValueError) as error:
        raise LogUnreadableError(f"{signer}: the signer's memory cannot be read: {error}") from error


class _Row(NamedTuple):
    columns: tuple[object, ...]
    hash: bytes
    sequence: int
    detail: bytes

    def follows(self, previous: bytes, sequence: int) -> bool:
        try:
            return follows(previous, (sequence, *self.columns[1:]), self.hash)
        except UnicodeEncodeError:  # bytes that no writer stored
            return False


def _row(row: tuple[object, ...]) -> _Row:
    sequence, digest, detail = row[0], row[-1], row[_DETAIL]
    if not (isinstance(sequence, int) and isinstance(digest, bytes) and isinstance(detail, bytes)):
        raise sqlite3.DataError("a column has a value of another type than a log's tables hold")
    return _Row(row[:-1], digest, sequence, detail)


def _log_id(connection: sqlite3.Connection) -> str:
    try:
        rows = connection.execute("SELECT id FROM log LIMIT 2").fetchall()
    except sqlite3.DatabaseError:
        return ""  # no such table: `_check_structure` reports it
    found = rows[0][0] if len(rows) == 1 else None
    return found if isinstance(found, str) and _LOG_ID.fullmatch(found) else ""


class _Findings:
    """The faults of a log. After `_MAX_FINDINGS`, one finding stands for all further ones."""

    def __init__(self) -> None:
        self.rows: list[LogFinding] = []
        self._further: LogFinding | None = None
        self._untold = 0

    @property
    def full(self) -> bool:
        return len(self.rows) >= _MAX_FINDINGS

    def add(self, kind: FindingKind, first: int, last: int, message: str) -> None:
        if not self.full:
            name = f"record {first}" if first == last else f"records {first} to {last}"
            self.rows.append(LogFinding(kind, first, last, f"{name}: {message}"))
        else:
            first = first if self._further is None else self._further.first
            self._untold += 1
            message = (
                f"records {first} to {last}: {counted(self._untold, 'further finding')}, not told one by one"
            )
            self._further = LogFinding(kind, first, last, message)

    def structure(self, message: str) -> None:
        message = message.encode("utf-8", "backslashreplace").decode()  # bytes that were not text
        self.rows.append(LogFinding(FindingKind.STRUCTURE, 0, 0, f"database: {message}"))

    def in_order(self) -> list[LogFinding]:
        rows = sorted(self.rows, key=lambda finding: finding.first)
        return rows if self._further is None else [*rows, self._further]


class _Verifier:
    def __init__(
        self,
        connection: sqlite3.Connection,
        log: str,
        key: bytes | None,
        remembered: SignerMemory | None,
        *,
        copies: Sequence[SignedCheckpoint] | None,
        progress: Callable[[int], None],
    ) -> None:
        self._connection = connection
        self._progress = progress
        self._key = key
        self._log = log
        self._checkpoints = CheckpointVerifier(self._log, key, remembered)
        self._copies = None if copies is None else CopiesVerifier(self._log, key, copies)
        self._findings = _Findings()
        self._sealed: dict[int, bytes] = {}
        self._reported: set[int] = set()
        self._shift = 0
        self._explained = 0
        self.records = self.first = self.last = 0

    def run(self) -> Verification:
        self._check_structure()
        if not self._log:
            self._findings.structure("table log does not have the one id of a log: what it sealed is unknown")
        removed = self._last_removal()
        audit, copies = self._checkpoints, self._copies
        try:
            audit.read(self._connection)
        except sqlite3.DatabaseError as error:
            self._findings.structure(f"the checkpoints cannot be read: {error}")
        sealed = audit.sequences | (copies.sequences if copies else set())
        self._sealed = dict.fromkeys(sealed, b"")
        self._walk(removed)
        chain = {sequence: digest for sequence, digest in self._sealed.items() if digest}
        last = self.last - self._shift
        self._findings.rows += audit.check(removed, chain, last, self._reported)
        if copies is not None:
            texts = {row.number: row.text for row in audit.rows() if row.number in copies.numbers}
            if removed.last_sequence:
                chain[removed.last_sequence] = bytes.fromhex(removed.last_hash)
            self._findings.rows += copies.check(chain, removed.last_sequence, last, texts)
        removal = self._check_removal(removed)
        findings = self._findings.in_order()
        return Verification(
            ok=not findings, log=self._log, records=self.records, first=self.first, last=self.last,
            removed=removed.last_sequence, checkpoints=audit.count,
            signed_checkpoints=audit.signed, signed_through=audit.signed_through,
            unsealed=max(0, self.last - audit.signed_through), key=self._key.hex() if self._key else None,
            findings=findings, elsewhere=copies.result() if copies else None, removal=removal,
            remembered=audit.remembered, other_logs=audit.other_logs,
        )  # fmt: skip

    def _check_removal(self, removed: RemovedRange) -> str:
        """Return "signed", "unsigned", or "" without a removal.

        Only versions that never signed removals made unsigned ones. So with a signed statement that has a smaller
        `removed`, an unsigned removal is a finding.
        """
        if not (removed.last_sequence or removed.last_checkpoint):
            return ""
        if self._key is None:
            return "unsigned"  # without a key, no signature can be checked
        key, statement = self._key.hex(), removed.statement(self._log, removed.limit)
        if signature_fault(statement, removed.signature, key, key, signature_is_valid) is None:
            return "signed"
        said = self._checkpoints.removed + (self._copies.removed if self._copies else [])
        if min(said, default=removed.last_sequence) < removed.last_sequence or not self._checkpoints.signed:
            message = (
                "said to have been removed for their age or the log's size, and the signer did not sign that: nothing"
                " shows that they had to go"
            )
            self._findings.add(FindingKind.REMOVAL_UNFOUNDED, 1, removed.last_sequence, message)
        return "unsigned"

    # --- the database itself --------------------------------------------------------------------------------

    def _check_structure(self) -> None:
        found = self._connection.execute("SELECT name, sql FROM sqlite_schema WHERE sql IS NOT NULL")
        expected = set(log_database.TABLES)
        for name, sql in found:
            if sql not in expected and name not in _WORDS_TABLES:
                self._findings.structure(f"{name} does not belong to a log: {sql}")
            expected.discard(sql)
        for sql in sorted(expected):
            self._findings.structure(f"missing: {sql}")
        try:
            for (problem,) in self._connection.execute("PRAGMA integrity_check(20)"):
                if problem != "ok":
                    self._findings.structure(problem)
        except sqlite3.DatabaseError as error:
            self._findings.structure(str(error))

    def _last_removal(self) -> RemovedRange:
        try:
            found = last_removal(self._connection)
        except (*_NOT_AS_WRITTEN, sqlite3.DatabaseError):
            found = None  # a damaged record is found when it is walked
        return found or RemovedRange(0, 0, genesis(self._log).hex(), 0, 0, 0, NO_CHECKPOINT)

    # --- the chain ------------------------------------------------------------------------------------------

    def _walk(self, removed: RemovedRange) -> None:
        self.last, previous = removed.last_sequence, bytes.fromhex(removed.last_hash)
        try:
            for row in self._rows():
                self.records += 1
                if not self.records % _TOLD_EVERY:
                    self._progress(row.sequence)
                self.first = self.first or row.sequence
                previous = self._step(row, previous)
        except sqlite3.DatabaseError as error:
            after = self.last + 1
            self._findings.add(
                FindingKind.UNREADABLE, after, after, f"it and what follows cannot be read: {error}"
            )

    def _step(self, row: _Row, previous: bytes) -> bytes:
        sequence, expected = row.sequence, self.last + 1
        if sequence < expected:
            self._findings.add(
                FindingKind.INSERTED, sequence, sequence, "stands before the first record of the log"
            )
            return previous
        self.last = sequence
        if sequence <= self._explained:
            return previous
        if sequence > expected:
            self._findings.add(FindingKind.MISSING, expected, sequence - 1, "removed from the log")
        elif not row.follows(previous, sequence - self._shift):
            return self._explain(row, previous)
        self._note(row, sequence - self._shift)
        return row.hash

    def _note(self, row: _Row, place: int) -> None:
        if place in self._sealed:
            self._sealed[place] = row.hash
        if row.columns[_EVENT] == "checkpoint":
            try:
                self._reported.add(msgspec.json.decode(row.detail, type=_Reported).number)
            except _NOT_AS_WRITTEN:
                return  # a changed record, which the check of its hash reports

    def _rows(self, after: int = -(1 << 63), limit: int = -1) -> Iterator[_Row]:
        rows = self._connection.execute(
            f"SELECT {log_database.COLUMNS}, hash FROM record NOT INDEXED WHERE sequence > ?"  # noqa: S608  fixed names
            " ORDER BY sequence LIMIT ?",
            (after, limit),
        )
        return map(_row, rows)

    def _explain(self, row: _Row, previous: bytes) -> bytes:
        """Report why the row does not follow from the previous one, and return the hash to continue from.

        After `_MAX_FINDINGS`, no search is made, so that a forged log cannot take hours.
        """
        ahead = list(self._rows(row.sequence, _WINDOW)) if not self._findings.full else []
        place = row.sequence - self._shift
        order = _original_order([row, *ahead], previous, place) if ahead else []
        if not order:
            return self._changed_or_renumbered(row, ahead[0] if ahead else None, place)
        first, end = order[0].sequence, row.sequence + len(order) - 1
        if len(order) > 1 and max(written.sequence for written in order) == end:
            self._explained = end
            self._findings.add(
                FindingKind.REORDERED, row.sequence, end, "not in the order they were written in"
            )
            for offset, written in enumerate(order):
                self._note(written, place + offset)
            return order[-1].hash
        self._findings.add(
            FindingKind.INSERTED, row.sequence, first - 1, "inserted; what follows was renumbered"
        )
        self._explained = first - 1
        self._shift += first - row.sequence
        return previous

    def _changed_or_renumbered(self, row: _Row, following: _Row | None, place: int) -> bytes:
        fitting = (by for by in _DISTANCES if following and following.follows(row.hash, place + 1 + by))
        distance, sequence = next(fitting, 0), row.sequence
        if distance > 0:
            message = "removed; what follows was renumbered"
            self._findings.add(FindingKind.MISSING, place, place + distance - 1, message)
        elif distance < 0:
            message = "inserted with a hash of its own; what follows was renumbered"
            self._findings.add(FindingKind.INSERTED, sequence + distance, sequence - 1, message)
        else:
            message = (
                "does not have the content it was written with"
                f" (or record {sequence - 1} was replaced by one with a hash of its own)"
            )
            self._findings.add(FindingKind.CHANGED, sequence, sequence, message)
        self._shift -= distance
        self._note(row, place + distance)
        return row.hash


def _original_order(rows: list[_Row], previous: bytes, place: int) -> list[_Row]:
    """Return the rows that were written after `previous`, until they are a permutation of the first ones."""
    order: list[_Row] = []
    left = list(rows)
    while found := next((row for row in left if row.follows(previous, place + len(order))), None):
        order.append(found)
        left.remove(found)
        previous = found.hash
        if max(row.sequence for row in order) == rows[0].sequence + len(order) - 1:
            break
    return order
