"""Write and verify segments: the records between two consecutive signed checkpoints, as they leave the appliance.

A segment is NDJSON in ASCII: the header (`SegmentHeader`), and the records as `rosrv audit export` writes them. Its
name is the SHA-256 of its bytes. At the beginning of a log, `begin` is null; if retention removed the earlier
checkpoint, `after` has the last removed record.

1. The chain of the records leads from the hash of `begin` to the hash of `end`, and one key signed both. The hash in
   `after` is not signed, but no other one leads to the signed hash of `end`.
2. Each segment has exactly one valid spelling, so equal records have equal names.
3. Reading and writing need the memory of one record.
"""

import hashlib
import sqlite3
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Annotated, NamedTuple, Protocol

import msgspec

from appliance.audit.log.columns import StoredColumns, pack, to_columns
from appliance.audit.log.log_database import LogUnreadableError, reading
from appliance.audit.log.log_queries import chained_rows, number_of_records
from appliance.audit.log.record_format import entry_of, stored_entry
from appliance.audit.proof.chain_proofs import ChainProof, evidence_line
from appliance.audit.proof.checkpoints import last_removal
from appliance.audit.proof.copies import SignedCheckpoint, select_signed
from appliance.signing.log_proof import Excerpt, ProofFault, genesis

LONGEST_LINE = 2 << 20  # bytes; details have at most 64 KiB, and escapes take twelve times as many
_NOT_A_RECORD = (ValueError, KeyError, TypeError, RecursionError, OverflowError)


class SegmentError(ValueError):
    """A segment is invalid."""


class RecordPlace(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The sequence of a record, and its hash in hexadecimal."""

    sequence: Annotated[int, msgspec.Meta(ge=1)]
    hash: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]


class SegmentHeader(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The first line of a segment: its version, and the checkpoints around its records."""

    segment: int = 1
    begin: SignedCheckpoint | None
    after: RecordPlace | None = None
    end: SignedCheckpoint

    def line(self) -> bytes:
        return msgspec.json.encode(self) + b"\n"

    def follows(self, other: "SegmentHeader") -> bool:
        before = (other.end.sequence, bytes.fromhex(other.end.hash))
        return self.end.checkpoint.follows(other.end.checkpoint) and self.start == before

    @property
    def start(self) -> tuple[int, bytes]:
        place = self.begin or self.after
        return (0, genesis(self.end.log)) if place is None else (place.sequence, bytes.fromhex(place.hash))


class SegmentSummary(NamedTuple):
    """The name and header of a segment, and the times of its earliest and latest record (nanoseconds; 0: no record)."""

    name: str
    header: SegmentHeader
    first_time: int
    last_time: int

    @property
    def first(self) -> int:
        return self.header.start[0] + 1

    @property
    def last(self) -> int:
        return self.header.end.sequence


class LineReader(Protocol):
    """A binary file, compressed or not."""

    def readline(self, size: int, /) -> bytes:
        """Return the next line, at most `size` bytes of it."""


class _Bytes:
    """The bytes of a segment on their way: their hash, their number and the times of the records."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self.size = self.first_time = self.last_time = 0

    def add(self, line: bytes) -> bytes:
        self._hash.update(line)
        self.size += len(line)
        return line

    def saw(self, time: int) -> None:
        self.first_time = min(time, self.first_time) if self.first_time else time
        self.last_time = max(time, self.last_time)

    def summary(self, header: SegmentHeader) -> SegmentSummary:
        return SegmentSummary(self._hash.hexdigest(), header, self.first_time, self.last_time)


def write_segment(log: Path, number: int, write: Callable[[bytes], object]) -> SegmentSummary | None:
    """Write the segment up to checkpoint `number`. Return None if it is not signed yet, or its records were removed.

    Raises `LogUnreadableError`, and the errors of `write`.
    """
    with reading(log) as connection:
        connection.execute("BEGIN")
        header = _header(connection, number)
        if header is None:
            return None
        end = header.end
        sequence, digest = header.start
        if number_of_records(connection, sequence, end.sequence) != end.sequence - sequence:
            return None
        done = _Bytes()
        write(done.add(header.line()))
        for row in chained_rows(connection, sequence, end.sequence):
            columns = StoredColumns(*row[:-1])
            write(done.add(_line(columns, digest, row[-1], end)))
            done.saw(columns.time)
            digest = row[-1]
    if digest.hex() != end.hash:
        raise LogUnreadableError(
            f"{log}: its records do not lead to checkpoint {number}; run 'rosrv audit verify'"
        )
    return done.summary(header)


def next_segment(log: Path, after: int) -> int | None:
    """Return the first checkpoint above `after`, signed or not. Raises `LogUnreadableError`."""
    query = "SELECT min(number) FROM checkpoint WHERE number > ?"
    with reading(log) as connection:
        number: int | None = connection.execute(query, (after,)).fetchone()[0]
    return number


def _header(connection: sqlite3.Connection, number: int) -> SegmentHeader | None:
    checkpoints = select_signed(connection, "number IN (?, ?) ORDER BY number", number - 1, number)
    if not checkpoints or checkpoints[-1].number != number:
        return None
    if len(checkpoints) == 2 or number == 1:
        return SegmentHeader(begin=checkpoints[0] if len(checkpoints) == 2 else None, end=checkpoints[-1])
    removed = last_removal(connection)
    if removed is None or removed.last_checkpoint != number - 1:
        return None
    after = RecordPlace(sequence=removed.last_sequence, hash=removed.last_hash)
    return SegmentHeader(begin=None, after=after, end=checkpoints[-1])


def _line(columns: StoredColumns, previous: bytes, digest: bytes, end: SignedCheckpoint) -> bytes:
    ends = end if columns.sequence == end.sequence else None
    proof = ChainProof(previous=previous.hex(), hash=digest.hex(), then=[], checkpoint=ends)
    return evidence_line(stored_entry(columns), proof).encode("ascii") + b"\n"


class SegmentReader:
    """Verifies a segment with one of the raw public keys `keys`, and yields its records; iterate once.

    A record that was yielded is proven only when the iteration has ended. Iteration raises `SegmentError`.
    """

    def __init__(self, file: LineReader, keys: Collection[bytes], most_bytes: int) -> None:
        """Read the header. Raises `SegmentError`."""
        self._file = file
        self._left = most_bytes
        self._done = _Bytes()
        self._ended = False
        line = self._read()
        try:
            self.header = msgspec.json.decode(line, type=SegmentHeader)
            wrong = (
                "not in its one valid spelling" if self.header.line() != line else _fault(self.header, keys)
            )
        except _NOT_A_RECORD as error:
            wrong = str(error)
        if wrong is not None:
            raise SegmentError(f"line 1, the header: {wrong}")

    def _read(self) -> bytes:
        line = self._file.readline(min(LONGEST_LINE, self._left) + 1)
        self._left -= len(line)
        if self._left < 0:
            raise SegmentError("it is larger than the limit")
        if len(line) > LONGEST_LINE:
            raise SegmentError(f"a line has more than {LONGEST_LINE} bytes")
        if line and not line.endswith(b"\n"):
            raise SegmentError("it was cut: its last line has no end")
        return self._done.add(line)

    def __iter__(self) -> Iterator[StoredColumns]:
        end, walk = self.header.end, Excerpt(*self.header.start)
        while line := self._read():
            if walk.sequence >= end.sequence:
                raise SegmentError(f"it has more records than up to {end.sequence}")
            columns = self._record(line, walk)
            self._done.saw(columns.time)
            yield columns
        if walk.sequence != end.sequence:
            raise SegmentError(f"records {walk.sequence + 1} to {end.sequence} are missing at its end")
        if end.checkpoint.contradiction(walk.sequence, walk.hash):
            raise SegmentError(f"its records do not lead to the hash of checkpoint {end.number}")
        self._ended = True

    def _record(self, line: bytes, walk: Excerpt) -> StoredColumns:
        previous, sequence = walk.hash, walk.sequence + 1
        try:
            fields = msgspec.json.decode(line)
            entry, chain = entry_of(fields), msgspec.convert(fields["chain"], ChainProof)
            columns, digest = to_columns(entry.record, entry.sequence), bytes.fromhex(chain.hash)
            faults = walk.add(columns.sequence, previous, pack(columns), digest)
            same = bool(faults) or _line(columns, previous, digest, self.header.end) == line
        except _NOT_A_RECORD as error:
            raise SegmentError(f"record {sequence}: {error}") from error
        if faults:
            raise SegmentError(
                f"record {sequence} does not follow record {sequence - 1}: changed, missing or moved"
            )
        if not same:
            raise SegmentError(f"record {sequence} is not in its one valid spelling")
        return columns

    def summary(self) -> SegmentSummary:
        """Read the rest, and return the summary of the proven segment. Raises `SegmentError`."""
        if not self._ended:
            for _columns in self:
                pass
        return self._done.summary(self.header)


def _fault(header: SegmentHeader, keys: Collection[bytes]) -> str | None:
    begin, end = header.begin, header.end
    if header.segment != 1:
        return f"version {header.segment} is not known; update the collector"
    known = sorted(key.hex() for key in keys)
    if end.key not in known:
        return f"checkpoint {end.number} is signed with {end.key[:64]}, expected is {' or '.join(known)}"
    for checkpoint in filter(None, (begin, end)):
        match checkpoint.fault(end.key):
            case ProofFault.KEY:
                return f"checkpoint {checkpoint.number} is signed with {checkpoint.key[:64]}, expected is {end.key}"
            case ProofFault.SIGNATURE:
                return f"the signature of checkpoint {checkpoint.number} is wrong"
    if begin is not None and header.after is not None:
        return "it has both begin and after"
    if header.after is not None:
        follows_begin = end.number > 1 and header.after.sequence <= end.sequence
    else:
        follows_begin = end.checkpoint.follows(None if begin is None else begin.checkpoint)
    return (
        None
        if follows_begin
        else f"checkpoint {end.number} does not follow the one that the segment begins with"
    )
