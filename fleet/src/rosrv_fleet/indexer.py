"""Copy stored segments to the index. The store works without it, and the index catches up later.

Robots take turns with one segment each, and large segments have their own turns (`LANES`). A segment that cannot be
indexed is set aside, and `collector.py` lets it try again every hour.
"""

import gzip
import threading
import zlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from concurrent.futures import CancelledError
from concurrent.futures.process import BrokenProcessPool
from datetime import UTC, date, datetime, timedelta

import msgspec
import psycopg
import structlog
from psycopg import sql

from appliance.audit.log.columns import StoredColumns
from appliance.base import clock
from appliance.formats.segments import SegmentError, SegmentReader
from rosrv_fleet.config import FleetConfig
from rosrv_fleet.database import INCOMPLETE, IndexDatabase, is_complete, migrate, note_complete, too_few_locks
from rosrv_fleet.enrolment import Robot
from rosrv_fleet.failures import failure_of
from rosrv_fleet.robots import Robots
from rosrv_fleet.segment_store import FileStamp, SegmentPlace, SegmentStore
from rosrv_fleet.workers import Workers

LANES = ("pending", "large")
"""The markers of waiting segments. Each lane is indexed by a separate thread."""
_IDLE_SECONDS = 1.0
_PAUSE_SECONDS = 5.0
_CHECK_SECONDS = 60.0  # without a segment to index, a failure of the database is noticed within this time
_SECOND = 1_000_000_000
_COLUMNS = ("day", "robot", "log", *StoredColumns._fields, "who")
_LONGEST_ID, _LONGEST_NAME = 64, 512  # characters: a row of an index of PostgreSQL has at most 2,704 bytes
_WHOLE = {"reason", "detail"}  # not in such an index
_UNREADABLE = (SegmentError, OSError, EOFError, zlib.error, ValueError)
_UNSTORABLE = (psycopg.DataError, psycopg.IntegrityError, psycopg.errors.ProgramLimitExceeded)
NOT_INDEXABLE = (*_UNREADABLE, *_UNSTORABLE)
"""The errors of segments that cannot be indexed, but stay stored."""
_MAX_KILLED = 3  # workers that one segment may cost
_PARTITION_LOCK = (
    0x726F7370  # of the transactions that make partitions: the second of two with one name would fail
)
_log = structlog.get_logger()


class Indexer:
    """Indexes the marked segments of a store. `run` is called by one thread for each lane."""

    def __init__(self, store: SegmentStore, robots: Robots, workers: Workers, config: FleetConfig) -> None:
        self._store = store
        self._robots = robots
        self._workers = workers
        self._config = config
        self._ending = threading.Event()
        self._wake = {lane: threading.Event() for lane in LANES}
        self._failures: dict[str, str | None] = dict.fromkeys(LANES, "the index was not reached yet")
        self._checked = dict.fromkeys(LANES, 0.0)
        self._damage = self._incomplete = self._locks = ""
        self._killed = Counter[SegmentPlace]()

    @property
    def trouble(self) -> str | None:
        failures = [reason for reason in self._failures.values() if reason is not None]
        if failures or self._incomplete:
            return failures[0] if failures else self._incomplete
        is_damaged = self._damage and any(map(self._is_damaged, self._robots.known()))
        return (self._damage if is_damaged else self._locks) or None

    def _is_damaged(self, robot: str) -> bool:
        return bool(self._store.marks("damaged", robot, 1))

    def wake(self) -> None:
        for waking in self._wake.values():
            waking.set()

    def stop(self) -> None:
        self._ending.set()
        self.wake()

    def run(self, lane: str) -> None:
        while not self._ending.is_set():
            self._wake[lane].clear()
            pause = self.turn(lane)
            waking = self._wake[lane] if self._failures[lane] is None else self._ending
            waking.wait(pause)

    def turn(self, lane: str) -> float:
        """Index what waits, and return the seconds until the next turn. Note a failure for `trouble`.

        Without segments the database is checked every minute, because its failure also ends searches.
        """
        try:
            now = clock.now()
            every = _PAUSE_SECONDS if self._incomplete else _CHECK_SECONDS
            if self._failures[lane] is not None or now - self._checked[lane] >= every:
                with psycopg.connect(self._config.database, connect_timeout=5) as connection:
                    migrate(connection)
                    if not is_complete(connection) and self._store.all_wait():
                        note_complete(connection)  # before this lane, or the other one, indexes the first
                    self._incomplete = "" if is_complete(connection) else INCOMPLETE
                    self._locks = too_few_locks(connection, self._config.limits.searches)
                self._checked[lane] = now
            return 0.0 if self.step(lane) else _IDLE_SECONDS
        except Exception as error:  # noqa: BLE001  after any failure, segments are indexed later
            if not self._ending.is_set():
                self._failed(lane, failure_of(error))
            return _PAUSE_SECONDS

    def step(self, lane: str) -> bool:
        """Index one segment of each robot, and return whether there were any.

        Raise `psycopg.Error`, `OSError`, and `BrokenProcessPool` if a worker was killed.
        """
        found = False
        killed: BrokenProcessPool | None = None
        waiting = self._store.robots_with(lane)
        robots = self._robots.known()  # after: a robot is enrolled before its first segment
        for robot in waiting:
            if robot not in robots and robot in self._robots.unreadable:
                continue
            for place in self._store.marks(lane, robot, 1):
                if self._ending.is_set():
                    return False
                found = True
                try:
                    self._index_in_worker(place, robots.get(robot))
                except BrokenProcessPool as error:  # perhaps by this segment: the next robot has its turn
                    killed = error
        if killed is not None:
            raise killed
        if self._failures[lane] is not None:
            _log.info("segments are indexed again", lane=lane)
            self._failures[lane] = None
        return found

    def _index_in_worker(self, place: SegmentPlace, robot: Robot | None) -> None:
        stamp = self._store.stamp(place)
        if robot is None:
            self._set_aside(place, stamp, "its robot is not enrolled")
            return
        oldest = self._config.retention.oldest_day(self._store.time_ns())
        work = self._workers.submit(_index_one, self._config, place, robot.public_keys, oldest)
        try:
            work.result()
        except FileNotFoundError:
            self._store.forget_absent(place)
        except NOT_INDEXABLE as error:
            self._set_aside(place, stamp, str(error).strip().partition("\n")[0])
        except BrokenProcessPool:
            self._killed[place] += 1
            if self._killed[place] < _MAX_KILLED:
                raise
            self._set_aside(place, stamp, f"{_MAX_KILLED} workers ended while they indexed it")
        except (psycopg.Error, OSError, CancelledError):  # not the segment's fault
            raise
        except Exception as error:  # noqa: BLE001  a defect, or no memory, must not delay other segments
            self._set_aside(place, stamp, failure_of(error))
        else:
            self._store.mark_indexed(place)
            self._killed.pop(place, None)

    def _set_aside(self, place: SegmentPlace, stamp: FileStamp | None, reason: str) -> None:
        """Set a segment aside, unless the robot has replaced the file since: then it stays marked for its next turn."""
        if self._store.set_aside(place, stamp):
            self._damage = f"{self._store.path(place)}: {reason}; run 'rosrv-fleet verify {place.robot}'"
            _log.error("a segment is stored, but cannot be indexed", reason=self._damage)
        self._killed.pop(place, None)

    def _failed(self, lane: str, reason: str) -> None:
        if reason != self._failures[lane]:
            _log.error("segments are stored, but not indexed", reason=reason)
        self._failures[lane] = reason


_database: IndexDatabase | None = None  # of this worker: a connection for all its segments


def _index_one(
    config: FleetConfig, place: SegmentPlace, keys: Collection[bytes], oldest: date | None
) -> None:
    global _database  # noqa: PLW0603  a worker has nothing else that lives as long
    if _database is None:
        _database = IndexDatabase(
            config.database, connections=1, statement_seconds=config.limits.search_seconds
        )
        _database.open()
    store = SegmentStore(config.data, config.limits.reserve_bytes)
    index(_database, store, place, keys, config, oldest=oldest)


def index(
    database: IndexDatabase,
    store: SegmentStore,
    place: SegmentPlace,
    keys: Collection[bytes],
    config: FleetConfig,
    *,
    oldest: date | None,
) -> bool:
    """Index one segment. Return False if it was already indexed, or arrived before `oldest`, the index's first day.

    Raise `psycopg.Error`; for an unreadable segment `OSError`, `EOFError`, `zlib.error` or `SegmentError`.
    """
    received = store.arrival_time(place)
    day = datetime.fromtimestamp(received // _SECOND, UTC).date()
    if oldest is not None and day < oldest:
        return False
    make_partition(database, day)
    try:
        with gzip.open(store.path(place)) as file, database.writing() as connection:
            reader = SegmentReader(file, keys, config.limits.segment_bytes)
            begin, end = reader.header.start[0], reader.header.end.sequence
            inserted = connection.execute(
                "INSERT INTO segment (robot, log, number, hash, first, last, received, day)"
                " VALUES (%s, %s, %s, %s, %s, %s, %s, %s) ON CONFLICT DO NOTHING RETURNING 1",
                (*place, begin + 1, end, received, day),
            ).fetchone()
            if inserted is None:
                return False
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
            return True
    except psycopg.errors.CheckViolation:
        if day != oldest:
            raise
        return False  # the day has ended, and retention dropped its partition in between


def make_partition(database: IndexDatabase, day: date) -> None:
    """Make the partition of a day, unless it exists.

    The table is made first and then attached, because that does not block searches or wait for them.
    """
    name = f"record_{day:%Y%m%d}"
    with database.writing() as connection:
        connection.execute("SELECT pg_advisory_xact_lock(%s)", (_PARTITION_LOCK,))
        found = connection.execute("SELECT to_regclass(%s)", (name,)).fetchone()
        if found is not None and found[0] is not None:
            return
        table = sql.Identifier(name)
        connection.execute(sql.SQL("CREATE TABLE {} (LIKE record INCLUDING CONSTRAINTS)").format(table))
        connection.execute(
            sql.SQL("ALTER TABLE record ATTACH PARTITION {} FOR VALUES FROM ({}) TO ({})").format(
                table, sql.Literal(day.isoformat()), sql.Literal((day + timedelta(1)).isoformat())
            )
        )


def rows(records: Iterable[StoredColumns], day: str, place: SegmentPlace) -> Iterator[tuple[object, ...]]:
    """Yield the rows of the index. NUL becomes U+2400, and names that are too long for the index are cut."""
    for columns in records:
        detail = columns.detail.decode()
        who = msgspec.json.decode(columns.detail).get("who")
        values = columns._replace(detail=detail)._asdict() | {"who": who if isinstance(who, str) else None}  # type: ignore[arg-type]  # text here
        yield (day, place.robot, place.log, *(_storable(name, value) for name, value in values.items()))


def _storable(name: str, value: object) -> object:
    if not isinstance(value, str):
        return value
    longest = len(value) if name in _WHOLE else _LONGEST_ID if name == "id" else _LONGEST_NAME
    if len(value) > longest:
        value = value[: longest - 1] + "…"
    return value.replace("\0", "\u2400") if "\0" in value else value
