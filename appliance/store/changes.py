"""The changes of the state file as typed rows, and the SQL that carries them out. No SQL text is stored or sent.

`Tables` is the only place that makes SQL of changes. It checks each change against the schema, so a change from a file
or from another appliance can only put or delete rows of known tables, with values of the columns' types.
"""

import contextlib
import sqlite3
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any, Literal, NamedTuple

import msgspec

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


class ChangeError(ValueError):
    """A change does not fit the tables of the state; the text names the table and the column."""


class Put(msgspec.Struct, frozen=True, array_like=True, tag="put"):
    """Store these rows of a table; each replaces the row with the same key."""

    table: str
    rows: Sequence[Sequence[Any]]


class Delete(msgspec.Struct, frozen=True, array_like=True, tag="delete"):
    """Delete the rows of a table that meet all conditions."""

    table: str
    conditions: Sequence[Condition]


Change = Put | Delete


class _Column(NamedTuple):
    types: tuple[type, ...]
    nullable: bool

    def problem(self, value: Any) -> str:
        """Return the reason why the column cannot have this value; empty if it can."""
        if value is None:
            return "" if self.nullable else "must have a value"
        if not isinstance(value, self.types):
            return f"cannot be of type {type(value).__name__}"
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
        """Raise `ChangeError` unless the change fits the tables."""
        columns = self._columns.get(change.table)
        if columns is None:
            raise ChangeError(f"the state has no table {change.table[:80]!r}")
        if isinstance(change, Put):
            if not 0 < len(change.rows) <= ROWS:
                raise ChangeError(f"a change of {change.table} has {len(change.rows)} rows, not 1 to {ROWS}")
            for row in change.rows:
                if len(row) != len(columns):
                    raise ChangeError(f"a row of {change.table} has {len(columns)} values, not {len(row)}")
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
        """Return the SQL of a change that was checked, and its values."""
        if isinstance(change, Put):
            marks = f"({', '.join('?' * len(change.rows[0]))})"
            rows = ", ".join([marks] * len(change.rows))
            values = [value for row in change.rows for value in row]
            return f"INSERT OR REPLACE INTO {change.table} VALUES {rows}", values  # noqa: S608  checked names
        wanted = " AND ".join(f"{name} {comparison} ?" for name, comparison, _value in change.conditions)
        values = [value for _name, _comparison, value in change.conditions]
        return f"DELETE FROM {change.table} WHERE {wanted}", values  # noqa: S608  checked names


def joined(changes: Sequence[tuple[Change, bool]]) -> Iterator[tuple[Change, bool]]:
    """Yield the changes, joining consecutive rows of a table: each change delays the loop's thread.

    The second value of each pair is kept; only rows with equal values are joined.
    """
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
