"""The changes of the state file as typed rows, the SQL that carries them out, and their write-ahead file.

Only `Tables` makes SQL, and it checks each change against the schema. So a change from a file or from another
appliance can only put or delete rows of known tables, with values of the columns' types.

`WriteAhead` keeps changes in a file until the database has stored them, so that a killed process loses none. A commit
of each change instead would make the thread that answers nodes wait for SQLite's one writer. A power failure before
`sync` may leave any part of the file. Reading ends at the first change that is torn, damaged, or follows a missing one;
no caller has awaited such a change.
"""

import contextlib
import errno
import os
import re
import sqlite3
import struct
import threading
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec

from appliance.base.counted import counted

Value = str | int | float | bytes | None
Comparison = Literal["=", "<", "<=", ">"]
Condition = tuple[str, Comparison, Any]

ROWS = 64  # rows in one change: SQLite limits the number of values in a statement
_CONDITIONS = 16
_TYPES: dict[str, tuple[type, ...]] = {
    "TEXT": (str,),
    "INTEGER": (int,),
    "REAL": (float, int),
    "BLOB": (bytes,),
}
_INTEGERS = 1 << 63
_SURROGATE = re.compile("[\ud800-\udfff]")

_HEAD = struct.Struct(">II")  # length with the mark, checksum
_NUMBERS = struct.Struct(">QQ")  # number of the change, number of the change before it in this file
_MARK = 1 << 31


class ChangeError(ValueError):
    """A change does not fit the tables of the state."""


class Put(msgspec.Struct, frozen=True, array_like=True, tag="put"):
    """Store these rows; each replaces the row with the same key."""

    table: str
    rows: Sequence[Sequence[Any]]


class Delete(msgspec.Struct, frozen=True, array_like=True, tag="delete"):
    """Delete the rows that meet all conditions."""

    table: str
    conditions: Sequence[Condition]


Change = Put | Delete


class _Column(NamedTuple):
    types: tuple[type, ...]
    nullable: bool

    def problem(self, value: object) -> str:
        if value is None:
            return "" if self.nullable else "must have a value"
        if not isinstance(value, self.types):
            return f"cannot be of type {type(value).__name__}"
        if isinstance(value, str) and _SURROGATE.search(value):
            return "has a character that UTF-8 lacks"
        if isinstance(value, int) and not -_INTEGERS <= value < _INTEGERS:
            return "is outside the range of 64 bits"
        return "is not a number" if value != value else ""  # noqa: PLR0124  NaN, which SQLite stores as NULL


class Tables:
    """The tables that `schema` creates."""

    def __init__(self, schema: str) -> None:
        self._columns: dict[str, dict[str, _Column]] = {}
        with contextlib.closing(sqlite3.connect(":memory:")) as connection:
            connection.executescript(schema)
            found = connection.execute(
                'SELECT t.name, c.name, c.type, c."notnull" = 0 AND c.pk = 0 FROM sqlite_master AS t'
                " JOIN pragma_table_info(t.name) AS c WHERE t.type = 'table' ORDER BY t.rowid, c.cid"
            )
            for table, column, kind, nullable in found:
                self._columns.setdefault(table, {})[column] = _Column(_TYPES[kind], bool(nullable))

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def check(self, change: Change) -> None:
        """Raise `ChangeError` unless the change fits."""
        columns = self._columns.get(change.table)
        if columns is None:
            raise ChangeError(f"the state has no table {change.table[:80]!r}")
        if isinstance(change, Put):
            if not 0 < len(change.rows) <= ROWS:
                raise ChangeError(
                    f"a change of {change.table} has {counted(len(change.rows), 'row')}, not 1 to {ROWS}"
                )
            for row in change.rows:
                if len(row) != len(columns):
                    raise ChangeError(
                        f"a row of {change.table} has {counted(len(columns), 'value')}, not {len(row)}"
                    )
                for value, (name, column) in zip(row, columns.items(), strict=True):
                    if problem := column.problem(value):
                        raise ChangeError(f"{change.table}.{name} {problem}")
            return
        if not 0 < len(change.conditions) <= _CONDITIONS:
            raise ChangeError(
                f"a deletion in {change.table} has {len(change.conditions)} conditions, not 1 to {_CONDITIONS}"
            )
        for name, _comparison, value in change.conditions:
            if name not in columns:
                raise ChangeError(f"{change.table} has no column {name[:80]!r}")
            if problem := columns[name]._replace(nullable=False).problem(value):
                raise ChangeError(f"{change.table}.{name} {problem}")

    @staticmethod
    def statement(change: Change) -> tuple[str, list[Value]]:
        if isinstance(change, Put):
            marks = f"({', '.join('?' * len(change.rows[0]))})"
            rows = ", ".join([marks] * len(change.rows))
            values = [value for row in change.rows for value in row]
            return f"INSERT OR REPLACE INTO {change.table} VALUES {rows}", values  # noqa: S608  checked names
        wanted = " AND ".join(f"{name} {comparison} ?" for name, comparison, _value in change.conditions)
        values = [value for _name, _comparison, value in change.conditions]
        return f"DELETE FROM {change.table} WHERE {wanted}", values  # noqa: S608  checked names


def join(changes: Sequence[tuple[Change, bool]]) -> Iterator[tuple[Change, bool]]:
    """Join consecutive rows of a table with the same second value, because each change delays the loop's thread."""
    if len(changes) == 1:
        yield changes[0]
        return
    for (table, ahead), same in groupby(changes, _table_of_rows):
        if table is None:
            yield from same
            continue
        rows = [row for change, _ahead in same if isinstance(change, Put) for row in change.rows]
        for start in range(0, len(rows), ROWS):
            yield Put(table, rows[start : start + ROWS]), ahead


def _table_of_rows(pair: tuple[Change, bool]) -> tuple[str | None, bool]:
    change, ahead = pair
    return change.table if isinstance(change, Put) else None, ahead


class Encoded(NamedTuple):
    """A change with its number, as MessagePack."""

    number: int
    body: bytes


class LeftBehind(NamedTuple):
    """The changes in the file after a crash."""

    changes: list[tuple[int, Change]]
    goes_on: bool = False
    """Whether the database has an earlier change of the process that made these."""


class WriteAheadClosedError(OSError):
    """The file was used after `close`."""


class WriteAhead:
    """The write-ahead file at `path`, for any thread. Raises `OSError`.

    The descriptor's number is read only under the lock, so no write after `close` goes to another file with it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._open_descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
        self._lock = threading.Lock()
        self._last = 0  # the number of the last change that was appended

    @contextmanager
    def _descriptor(self) -> Iterator[int]:
        with self._lock:
            if self._open_descriptor < 0:
                raise WriteAheadClosedError(errno.EBADF, "the state is already closed", str(self._path))
            yield self._open_descriptor

    def changes_after(self, stored: int) -> LeftBehind:
        """Return the changes after `stored`. Raises `ValueError` for an intact change that is not known here."""
        with self._descriptor() as descriptor:
            data = os.pread(descriptor, os.fstat(descriptor).st_size, 0)
        decoder = msgspec.msgpack.Decoder(Change)
        found = list(_after(stored, data))
        changes = [(number, decoder.decode(body)) for number, _previous, body in found]
        return LeftBehind(changes, goes_on=bool(found) and found[0][1] > 0)

    def append(self, changes: Sequence[Encoded]) -> None:
        """Append changes. Raises `OSError`, for example if the disk is full; then the file has none of them."""
        with self._descriptor() as descriptor:
            parts: list[bytes] = []
            last = self._last
            for number, body in changes:
                numbers = _NUMBERS.pack(number, last)
                checksum = zlib.crc32(body, zlib.crc32(numbers))
                parts += (_HEAD.pack(len(body) | _MARK, checksum), numbers, body)
                last = number
            data = b"".join(parts)
            written = os.write(descriptor, data)
            if written < len(data):
                os.ftruncate(descriptor, os.fstat(descriptor).st_size - written)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._last = last

    def stored(self, number: int) -> None:
        """Note that the database has the changes up to `number`, and empty the file if it has no others."""
        with self._descriptor() as descriptor:
            if number >= self._last:
                os.ftruncate(descriptor, 0)

    def clear(self) -> None:
        with self._descriptor() as descriptor:
            os.ftruncate(descriptor, 0)

    def sync(self) -> None:
        """Flush the file to the disk, while other threads may append. Raises `OSError`."""
        with self._descriptor() as descriptor:
            own = os.dup(descriptor)
        try:
            os.fsync(own)
        finally:
            os.close(own)

    def close(self) -> None:
        """Close the file, after any use in progress."""
        with self._lock:
            if self._open_descriptor >= 0:
                os.close(self._open_descriptor)
                self._open_descriptor = -1


def _after(stored: int, data: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yield the changes after `stored`: number, number of the process's change before it (0: none), and body."""
    position = 0
    while position + _HEAD.size + _NUMBERS.size <= len(data):
        marked, checksum = _HEAD.unpack_from(data, position)
        begin = position + _HEAD.size
        position = begin + _NUMBERS.size + (marked ^ _MARK)
        if position > len(data) or zlib.crc32(data[begin:position]) != checksum:
            return
        number, previous = _NUMBERS.unpack_from(data, begin)
        if previous > stored:
            return
        if number > stored:
            stored = number
            yield number, previous, data[begin + _NUMBERS.size : position]
