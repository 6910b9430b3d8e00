"""Append records to the database and extend the chain, on one thread of one process.

1. The head (sequence and hash) changes only after the commit that wrote it.
2. There is one writer: it holds a lock on `<log>.lock`.
3. If the file is removed or replaced, writing stops with an error.
"""

import contextlib
import fcntl
import functools
import itertools
import os
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import msgspec

from appliance.audit.log import log_database
from appliance.audit.log.columns import StoredColumns, follows, record_hash, to_columns
from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.record import AuditRecord
from appliance.audit.log.repetition import FoldState
from appliance.audit.log.retention import RemovedRange, as_kept
from appliance.signing.log_proof import NO_CHECKPOINT, Checkpoint, checkpoint_hash, genesis, parse_checkpoint

# Rows of one INSERT. Each statement releases the GIL and takes it again. This may take 5 ms (the switch interval) while
# an event loop is busy. With one row per statement, only 200 rows a second could be written.
_ROWS_PER_INSERT = 64
_WIDTH = len(StoredColumns._fields) + 1
_ROW = "(" + ", ".join("?" * _WIDTH) + ")"
_CHECKED_AT_OPENING = 256
_REPLACED = (
    "the log was removed or replaced while it was written; put it back, or stop the appliance and move what is"
    " there away to begin a new log"
)
_TEXT_ROWS = 256
_FOREVER = 1 << 63


@functools.cache
def _insert(rows: int) -> str:
    return "INSERT INTO record VALUES " + ", ".join([_ROW] * rows)  # noqa: S608  only question marks


@functools.cache
def _count(rows: int) -> str:
    """Return the statement that stores counts. An update changes one page; a replaced row would change three."""
    places = ", ".join(["(?, ?)"] * rows)
    return f"INSERT INTO open_fold VALUES {places} ON CONFLICT (key) DO UPDATE SET state = excluded.state"  # noqa: S608  only question marks


class ChainWriter:
    """The open database of a log and the head of its chain."""

    def __init__(self, path: Path, begun: int, continued: tuple[str, int] | None = None) -> None:
        """Open the log that is `continued` (id and last sequence), or create a missing one.

        Raises `LogUnreadableError`, `sqlite3.Error` or `OSError`.
        """
        self.path = path
        # The last of the first checkpoints with a time in the future, and the earliest time of these.
        self._ahead = 0, 0
        with contextlib.ExitStack() as opened:
            opened.callback(os.close, _take_lock(path))
            self.created = not path.exists()
            if self.created and continued is not None:
                raise LogUnreadableError(f"{path}: {_REPLACED}")
            if self.created:
                log_database.create(path, begun)
            self._connection = opened.enter_context(contextlib.closing(log_database.open_for_writing(path)))
            self._file = _identity(path)
            self._read_head()
            if continued is not None and (self.log_id != continued[0] or self.sequence < continued[1]):
                raise LogUnreadableError(f"{path}: {_REPLACED}")
            self._opened = opened.pop_all()

    def close(self) -> None:
        self._opened.close()

    def _read_head(self) -> None:
        execute = self._connection.execute
        (self.log_id,) = execute("SELECT id FROM log").fetchone()
        rows = execute(
            f"SELECT {log_database.COLUMNS}, hash FROM record ORDER BY sequence DESC LIMIT ?",  # noqa: S608  fixed names
            (_CHECKED_AT_OPENING,),
        ).fetchall()
        rows.reverse()
        self.sequence, self.hash, self.last_id = 0, genesis(self.log_id), ""
        for number, row in enumerate(rows):
            known = number > 0 or row[0] == 1  # the hash before this record is known
            if known and (row[0] != self.sequence + 1 or not follows(self.hash, row[:-1], row[-1])):
                raise LogUnreadableError(
                    f"{self.path}: record {row[0]} does not fit the chain, so the log was changed; run"
                    " 'rosrv audit verify', keep the file as evidence and move it away to begin a new log"
                )
            self.sequence, self.hash = row[0], row[-1]
            self.last_id = max(self.last_id, row[1])
        (self._text_through,) = execute("SELECT through FROM indexed").fetchone()
        self.checkpoint_number, self._sealed_through, self._checkpoint_hash = 0, 0, NO_CHECKPOINT
        newest = "SELECT number, sequence, text FROM checkpoint ORDER BY number DESC LIMIT 1"
        for self.checkpoint_number, self._sealed_through, text in execute(newest):
            self._checkpoint_hash = checkpoint_hash(text)

    @property
    def unsealed(self) -> int:
        """Return how many records the next checkpoint would seal, without the record of the last one."""
        return self.sequence - self._sealed_through

    def append(
        self, records: Sequence[AuditRecord], folds: Iterable[tuple[bytes, FoldState | None]] = ()
    ) -> None:
        with self._transaction(records) as execute:
            counted = list[tuple[bytes, bytes]]()
            for key, state in folds:
                if state is None:
                    execute("DELETE FROM open_fold WHERE key = ?", (key,))
                else:
                    counted.append((key, msgspec.json.encode(state)))
            for start in range(0, len(counted), _ROWS_PER_INSERT):
                part = counted[start : start + _ROWS_PER_INSERT]
                execute(_count(len(part)), list(itertools.chain.from_iterable(part)))

    def _insert(self, records: Sequence[AuditRecord]) -> tuple[int, bytes, str]:
        sequence, digest, last_id = self.sequence, self.hash, self.last_id
        for start in range(0, len(records), _ROWS_PER_INSERT):
            part, values = records[start : start + _ROWS_PER_INSERT], list[object]()
            for record in part:
                sequence += 1
                columns = to_columns(record, sequence)
                digest = record_hash(digest, columns)
                values += columns
                values.append(digest)
                last_id = max(last_id, columns.id)
            self._connection.execute(_insert(len(part)), values)
        return sequence, digest, last_id

    def seal(self, time: int, report: Callable[[Checkpoint], AuditRecord]) -> None:
        """Append a checkpoint of the chain, then a record of it."""
        number, removed = self.checkpoint_number + 1, self._first_sequence() - 1
        checkpoint = Checkpoint(
            self.log_id, number, self.sequence, self.hash.hex(), time, self._checkpoint_hash, removed
        )
        text = checkpoint.text()
        with self._transaction([report(checkpoint)]) as execute:
            execute(
                "INSERT INTO checkpoint (number, sequence, text) VALUES (?, ?, ?)",
                (number, checkpoint.sequence, text),
            )
        self.checkpoint_number, self._sealed_through = number, self.sequence
        self._checkpoint_hash = checkpoint_hash(text)

    def unsigned_checkpoints(self, after: int, limit: int) -> list[tuple[int, bytes]]:
        """Return the numbers and texts of unsigned checkpoints above the number `after`, oldest first."""
        query = "SELECT number, text FROM checkpoint WHERE signature IS NULL AND number > ? ORDER BY number LIMIT ?"
        return self._connection.execute(query, (after, limit)).fetchall()

    def checkpoint_text(self, number: int) -> bytes | None:
        row = self._connection.execute("SELECT text FROM checkpoint WHERE number = ?", (number,)).fetchone()
        return None if row is None else bytes(row[0])

    def keep_signature(self, number: int, signature: bytes, public_key: bytes) -> None:
        self._connection.execute(
            "UPDATE checkpoint SET signature = ?, public_key = ? WHERE number = ? AND signature IS NULL",
            (signature, public_key, number),
        )

    def open_folds(self) -> dict[bytes, FoldState]:
        rows = self._connection.execute("SELECT key, state FROM open_fold")
        return {key: msgspec.json.decode(state, type=FoldState) for key, state in rows}

    @property
    def text_lag(self) -> int:
        return int(self.sequence - self._text_through)

    def index_text(self, rows: int = _TEXT_ROWS) -> bool:
        through = self._text_through
        if through >= self.sequence:
            return False
        end = min(through + rows, self.sequence)
        with self._transaction() as execute:
            execute(
                f"INSERT INTO words (rowid, text) SELECT sequence, {log_database.TEXT_OF_RECORD} FROM record"  # noqa: S608  fixed names
                " WHERE sequence > ? AND sequence <= ?",
                (through, end),
            )
            execute("UPDATE indexed SET through = ?", (end,))
        self._text_through = end
        return bool(end < self.sequence)

    def size(self) -> int:
        (size,) = self._connection.execute(
            "SELECT (page_count - freelist_count) * page_size"
            " FROM pragma_page_count, pragma_freelist_count, pragma_page_size"
        ).fetchone()
        return int(size)

    def removable(
        self, step: int, *, signed: bool, before: int = _FOREVER, now: int = _FOREVER
    ) -> RemovedRange | None:
        """Return the range of about `step` oldest records that ends at a (signed) checkpoint, but not the last one.

        The checkpoint was made before the time `before`. Checkpoints with a time after `now`, made while the clock was
        ahead, are removed with the following ones.
        """
        execute, first = self._connection.execute, self._first_sequence()
        passed, earliest = self._ahead if now < self._ahead[1] else (0, _FOREVER)
        rows = execute(
            "SELECT number, sequence, text FROM checkpoint WHERE sequence >= ? AND number > ? AND"
            " number < (SELECT max(number) FROM checkpoint) AND (signature IS NOT NULL OR NOT ?)"
            " ORDER BY number",
            (first, passed, signed),
        )
        upto: tuple[int, int, bytes] | None = None
        for row in rows:
            made = parse_checkpoint(row[2]).time
            if made > now:
                earliest = min(earliest, made)
                self._ahead = (row[0], earliest) if upto is None else self._ahead
                continue
            if made >= before or (upto is not None and row[1] >= first + step):
                break
            upto = row
        if upto is None:
            return None
        number, last, text = upto
        ends = "SELECT time, hash FROM record WHERE sequence = ?"
        first_time, _hash = execute(ends, (first,)).fetchone()
        last_time, last_hash = execute(ends, (last,)).fetchone()
        return RemovedRange(
            first, last, last_hash.hex(), first_time, last_time, number, checkpoint_hash(text)
        )

    def _first_sequence(self) -> int:
        query = "SELECT coalesce(min(sequence), ?) FROM record"
        return int(self._connection.execute(query, (self.sequence + 1,)).fetchone()[0])

    def newest_signed(self) -> bytes:
        query = "SELECT text FROM checkpoint WHERE signature IS NOT NULL ORDER BY number DESC LIMIT 1"
        row = self._connection.execute(query).fetchone()
        return b"" if row is None else bytes(row[0])

    def evidence(self, gone: RemovedRange) -> list[AuditRecord]:
        rows = self._connection.execute(
            f"SELECT {log_database.COLUMNS}, hash FROM record WHERE sequence <= ? AND"  # noqa: S608  fixed names
            " (decision = 'deny' OR severity = 'alarm') ORDER BY sequence",
            (gone.last_sequence,),
        )
        return [as_kept(StoredColumns(*row[:-1]), row[-1]) for row in rows]

    def remove(self, gone: RemovedRange, report: AuditRecord, kept: Sequence[AuditRecord] = ()) -> None:
        with self._transaction([report, *kept]) as execute:
            execute(
                f"INSERT INTO words (words, rowid, text) SELECT 'delete', sequence, {log_database.TEXT_OF_RECORD}"  # noqa: S608  fixed names
                " FROM record WHERE sequence <= ?",
                (min(gone.last_sequence, self._text_through),),
            )
            execute("UPDATE indexed SET through = max(through, ?)", (gone.last_sequence,))
            execute("DELETE FROM record WHERE sequence <= ?", (gone.last_sequence,))
            execute("DELETE FROM checkpoint WHERE number <= ?", (gone.last_checkpoint,))
        self._text_through = max(self._text_through, gone.last_sequence)
        self._connection.executescript("PRAGMA incremental_vacuum(256)")  # `execute` would free one page only

    @contextlib.contextmanager
    def _transaction(self, records: Sequence[AuditRecord] = ()) -> Iterator[Callable[..., sqlite3.Cursor]]:
        """Append records, and commit them with the statements of the block; a failure changes nothing."""
        if _identity(self.path) != self._file:
            raise LogUnreadableError(f"{self.path}: {_REPLACED}")
        with self._connection:
            self._connection.execute("BEGIN IMMEDIATE")
            head = self._insert(records)
            yield self._connection.execute
        self.sequence, self.hash, self.last_id = head


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_dev, status.st_ino


def _take_lock(path: Path) -> int:
    lock = os.open(path.with_name(path.name + ".lock"), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(lock)
        raise LogUnreadableError(f"{path}: another process writes this log: stop that appliance") from error
    return lock
