"""Copy stored segments to the index. The store works without it; the index catches up later.

A segment and its records are written in one transaction, once. Its marker in the store is removed afterwards.
"""

import contextlib
import gzip
import threading
import zlib
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import msgspec
import psycopg
import structlog
from psycopg import sql

from appliance.audit.chain import StoredColumns
from appliance.audit.segments import SegmentError, SegmentReader
from rosrv_fleet.database import Connection, Database, migrate
from rosrv_fleet.robots import EnrolmentError, Robots
from rosrv_fleet.segment_store import SegmentPlace, SegmentStore

_BATCH = 256
_IDLE_SECONDS = 1.0
_PAUSE_SECONDS = 5.0
_SECOND = 1_000_000_000
_COLUMNS = ("day", "robot", "log", *StoredColumns._fields, "who")
_UNREADABLE = (SegmentError, OSError, EOFError, zlib.error, EnrolmentError, msgspec.MsgspecError)
_log = structlog.get_logger()


class Indexer:
    """The indexer of a store: `index` for one segment, `run` for all that wait, until `stop`."""

    def __init__(self, store: SegmentStore, robots: Robots, database: Database, segment_bytes: int) -> None:
        self._store = store
        self._robots = robots
        self._database = database
        self._segment_bytes = segment_bytes
        self._ending = threading.Event()
        self._wake = threading.Event()
        self.trouble: str | None = "the index was not reached yet"

    def wake(self) -> None:
        """Note that a segment waits."""
        self._wake.set()

    def stop(self) -> None:
        """End `run` after the present segment."""
        self._ending.set()
        self._wake.set()

    def run(self) -> None:
        """Index what waits, until `stop`; a database that is down is tried again."""
        while not self._ending.is_set():
            self._wake.clear()
            try:
                if self.trouble is not None:
                    with self._database.writing() as connection:
                        migrate(connection)
                more = self.step()
            except psycopg.Error as error:
                self._failed(f"the database: {str(error).strip() or type(error).__name__}")
                self._ending.wait(_PAUSE_SECONDS)
                continue
            if not more:
                self._wake.wait(_IDLE_SECONDS if self.trouble is None else _PAUSE_SECONDS)

    def step(self) -> bool:
        """Index a batch; return whether more may wait. Raises `psycopg.Error`."""
        waiting = sorted(self._store.marked("pending", _BATCH))
        damaged = None
        for place in waiting:
            if self._ending.is_set():
                return False
            try:
                self.index(place)
            except FileNotFoundError:
                self._store.forget_absent(place)
                continue
            except _UNREADABLE as error:
                damaged = f"{self._store.path(place)}: {error}; run 'rosrv-fleet verify {place.robot}'"
                continue
            self._store.indexed(place)
        if damaged is not None:
            self._failed(damaged)
        elif self.trouble is not None:
            _log.info("the index is complete again")
            self.trouble = None
        return len(waiting) == _BATCH and damaged is None

    def _failed(self, reason: str) -> None:
        if reason != self.trouble:
            _log.error("segments are stored, but not indexed", reason=reason)
        self.trouble = reason

    def index(self, place: SegmentPlace) -> None:
        """Write one segment and its records to the index, unless it has them.

        Raises `psycopg.Error`; for an unreadable segment `OSError`, `EOFError`, `zlib.error` and `SegmentError`.
        """
        received = self._store.received(place)
        day = datetime.fromtimestamp(received // _SECOND, UTC).date()
        key = self._robots.named(place.robot).public_key
        with gzip.open(self._store.path(place)) as file, self._database.writing() as connection:
            reader = SegmentReader(file, key, self._segment_bytes)
            begin, end = reader.header.start[0], reader.header.end.sequence
            inserted = connection.execute(
                "INSERT INTO segment (robot, log, number, hash, first, last, received, day)"
                " VALUES (%s, %s, %s, %s, %s, %s, %s, %s) ON CONFLICT DO NOTHING RETURNING 1",
                (*place, begin + 1, end, received, day),
            ).fetchone()
            if inserted is None:
                return
            _make_partition(
                connection, f"record_{day:%Y%m%d}", day.isoformat(), (day + timedelta(1)).isoformat()
            )
            statement = sql.SQL("COPY record ({}) FROM STDIN").format(
                sql.SQL(", ").join(map(sql.Identifier, _COLUMNS))
            )
            with connection.cursor().copy(statement) as copy:
                for row in rows(reader, day.isoformat(), place):
                    copy.write_row(row)
            summary = reader.summary()
            connection.execute(
                "UPDATE segment SET first_time = %s, last_time = %s"
                " WHERE robot = %s AND log = %s AND number = %s AND hash = %s",
                (summary.first_time, summary.last_time, *place),
            )


def _make_partition(connection: Connection, name: str, begin: str, end: str) -> None:
    found = connection.execute("SELECT to_regclass(%s)", (name,)).fetchone()
    if found is not None and found[0] is not None:
        return
    with contextlib.suppress(psycopg.errors.DuplicateTable), connection.transaction():
        connection.execute(
            sql.SQL("CREATE TABLE {} PARTITION OF record FOR VALUES FROM ({}) TO ({})").format(
                sql.Identifier(name), sql.Literal(begin), sql.Literal(end)
            )
        )


def rows(records: Iterable[StoredColumns], day: str, place: SegmentPlace) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of records. PostgreSQL cannot store NUL: the index shows it as U+2400, the segment has it."""
    for columns in records:
        detail = columns.detail.decode()
        who = msgspec.json.decode(columns.detail).get("who")
        values = (*columns[:-1], detail, who if isinstance(who, str) else None)
        yield (day, place.robot, place.log, *(_storable(value) for value in values))


def _storable(value: Any) -> Any:
    return value.replace("\0", "\u2400") if isinstance(value, str) and "\0" in value else value
