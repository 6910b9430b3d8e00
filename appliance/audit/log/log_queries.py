"""Read facts of an open log: of single records, of runs of records, of the newest checkpoints.

Searches by filter are in `audit/search`, the verification in `audit/proof`. All other queries of the table `record` are
here. Functions raise `sqlite3.DatabaseError` for a damaged log.
"""

import sqlite3
from collections.abc import Iterator
from typing import NamedTuple

from appliance.audit.log.columns import StoredColumns
from appliance.audit.log.log_database import COLUMNS


class EventRow(NamedTuple):
    """A record's place, time in nanoseconds since the epoch, event, and detail as it is stored."""

    sequence: int
    time: int
    event: str
    detail: bytes


def log_id(connection: sqlite3.Connection) -> str:
    (log,) = connection.execute("SELECT id FROM log").fetchone()
    return str(log)


def record_extent(connection: sqlite3.Connection) -> tuple[int, int]:
    """Return the sequences of the first and the last record; 1 and 0 for an empty log."""
    query = "SELECT coalesce(min(sequence), 1), coalesce(max(sequence), 0) FROM record"
    first, last = connection.execute(query).fetchone()
    return int(first), int(last)


def record_hash(connection: sqlite3.Connection, sequence: int) -> bytes | None:
    rows = connection.execute("SELECT hash FROM record WHERE sequence = ?", (sequence,))
    return next((digest for (digest,) in rows), None)


def chained_rows(connection: sqlite3.Connection, after: int, upto: int) -> sqlite3.Cursor:
    """Yield the columns of each record after `after`, in order, and its hash."""
    return connection.execute(
        f"SELECT {COLUMNS}, hash FROM record WHERE sequence > ? AND sequence <= ? ORDER BY sequence",  # noqa: S608  fixed names
        (after, upto),
    )


def number_of_records(connection: sqlite3.Connection, after: int, upto: int) -> int:
    query = "SELECT count(*) FROM record WHERE sequence > ? AND sequence <= ?"
    return int(connection.execute(query, (after, upto)).fetchone()[0])


def first_time(connection: sqlite3.Connection, after: int, upto: int) -> int:
    """Return the time of the first record after `after`, in nanoseconds since the epoch; 0 without a record."""
    query = "SELECT time FROM record WHERE sequence > ? AND sequence <= ? ORDER BY sequence LIMIT 1"
    row = connection.execute(query, (after, upto)).fetchone()
    return 0 if row is None else int(row[0])


def last_detail(connection: sqlite3.Connection, event: str) -> bytes | None:
    """Return the detail of the last record of an event."""
    query = "SELECT detail FROM record WHERE event = ? ORDER BY sequence DESC LIMIT 1"
    row = connection.execute(query, (event,)).fetchone()
    return None if row is None else row[0]


def record_id(connection: sqlite3.Connection, sequence: int) -> str | None:
    rows = connection.execute("SELECT id FROM record WHERE sequence = ?", (sequence,))
    return next((record for (record,) in rows), None)


def sequence_of(connection: sqlite3.Connection, record: str) -> int | None:
    """Return the place of the record with an id."""
    return _place(connection, "SELECT max(sequence) FROM record WHERE id = ?", record)


def first_after_id(connection: sqlite3.Connection, record: str) -> int | None:
    """Return the place of the first record with a later id. Ids are ordered by time."""
    return _place(connection, "SELECT min(sequence) FROM record WHERE id > ?", record)


def stored_record(connection: sqlite3.Connection, sequence: int) -> StoredColumns | None:
    query = f"SELECT {COLUMNS} FROM record WHERE sequence = ?"  # noqa: S608  fixed names
    row = connection.execute(query, (sequence,)).fetchone()
    return None if row is None else StoredColumns(*row)


def sequences_in_period(
    connection: sqlite3.Connection, since: int, until: int, *, upto: int, limit: int
) -> list[int]:
    """Return the places of the records from `since` (inclusive) to `until`, in nanoseconds since the epoch."""
    rows = connection.execute(
        "SELECT sequence FROM record INDEXED BY record_time WHERE time >= ? AND time < ? AND sequence <= ?"
        " ORDER BY sequence LIMIT ?",
        (since, until, upto, limit),
    )
    return [sequence for (sequence,) in rows]


def records_of(connection: sqlite3.Connection, *events: str, after: int = 0, upto: int) -> Iterator[EventRow]:
    """Yield the records of these events, oldest first, by the index of events."""
    marks = ", ".join("?" * len(events))
    rows = connection.execute(
        f"SELECT sequence, time, event, CAST(detail AS BLOB) FROM record WHERE event IN ({marks})"  # noqa: S608  question marks
        " AND +sequence > ? AND +sequence <= ? ORDER BY sequence",  # by the index of events: `+` excludes the other
        (*events, after, upto),
    )
    return map(EventRow._make, rows)


def last_of(
    connection: sqlite3.Connection, event: str, before: int, revision: int | None = None
) -> int | None:
    """Return the place of the last record of an event before `before`; with `revision`, of that policy."""
    query = "SELECT max(sequence) FROM record INDEXED BY record_event WHERE event = ? AND sequence < ?"
    if revision is None:
        return _place(connection, query, event, before)
    return _place(connection, f"{query} AND revision = ?", event, before, revision)


def policies_of(connection: sqlite3.Connection, first: int, last: int) -> list[int]:
    """Return the revisions of the policies that were in force at these records."""
    query = "SELECT DISTINCT revision FROM record WHERE sequence BETWEEN ? AND ? AND revision > 0"
    return [revision for (revision,) in connection.execute(query, (first, last))]


def outer_decisions(connection: sqlite3.Connection, after: int, upto: int) -> Iterator[EventRow]:
    """Yield the first and the last decision that was made there; one twice if it is the only one.

    Retention writes old denials again, with their old time and `kept`; a quote inside a string is escaped.
    """
    for order in ("ASC", "DESC"):
        rows = connection.execute(
            "SELECT sequence, time, event, detail FROM record WHERE +event = 'decision' AND sequence > ?"  # noqa: S608  a fixed word
            f""" AND sequence <= ? AND instr(CAST(detail AS TEXT), '"kept":') = 0 ORDER BY sequence {order} LIMIT 1""",
            (after, upto),
        )
        yield from map(EventRow._make, rows)


def last_checkpoint(connection: sqlite3.Connection, upto: int) -> int:
    """Return the number of the last checkpoint at or before a record, or 0."""
    return _place(connection, "SELECT max(number) FROM checkpoint WHERE sequence <= ?", upto) or 0


def last_signed(connection: sqlite3.Connection) -> tuple[int, int]:
    """Return the number of the last signed checkpoint, and the sequence of the last sealed record; 0 without one."""
    query = "SELECT coalesce(max(number), 0), coalesce(max(sequence), 0) FROM checkpoint WHERE signature IS NOT NULL"
    number, sequence = connection.execute(query).fetchone()
    return int(number), int(sequence)


def _place(connection: sqlite3.Connection, query: str, *values: object) -> int | None:
    row: tuple[int | None] = connection.execute(query, values).fetchone()
    return row[0]
