"""Connect to PostgreSQL and apply the migrations.

The tables `segment` and `record` are an index, which `rosrv-fleet reindex` rebuilds from the stored segments. Each
migration `migrations/NNNN_name.sql` runs once, in order, and all pending ones in one transaction. Applied files never
change.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psycopg
import structlog
from psycopg_pool import ConnectionPool

MIGRATIONS = Path(__file__).with_name("migrations")
_MIGRATION_LOCK = 0x726F7372  # one collector migrates at a time
_CONNECT_SECONDS = 5.0
INCOMPLETE = "the index does not have all stored segments: run rosrv-fleet reindex, or wait for its end"
_log = structlog.get_logger()

Row = tuple[Any, ...]
Connection = psycopg.Connection[Row]


class IndexDatabase:
    """A bounded pool of connections. Thread-safe."""

    def __init__(self, conninfo: str, *, connections: int, statement_seconds: float) -> None:
        self._statement_ms = int(statement_seconds * 1000)
        self._pool: ConnectionPool[Connection] = ConnectionPool(
            conninfo,
            kwargs={"connect_timeout": int(_CONNECT_SECONDS), "application_name": "rosrv-fleet"},
            min_size=0,
            max_size=connections,
            timeout=_CONNECT_SECONDS,
            max_idle=60.0,
            check=ConnectionPool.check_connection,
            open=False,
        )

    def open(self) -> None:
        """Start connecting in the background. The database may be down."""
        self._pool.open(wait=False)

    def close(self) -> None:
        self._pool.close()

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """Run the block in one transaction. After a `psycopg.Error`, nothing is written."""
        with self._pool.connection() as connection:
            yield connection

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Run the block in one read-only transaction with the time limit of searches. Raise `psycopg.Error`."""
        with self._pool.connection() as connection:
            connection.execute("SET TRANSACTION READ ONLY")
            connection.execute("SELECT set_config('statement_timeout', %s, true)", (str(self._statement_ms),))
            yield connection


def is_complete(connection: Connection) -> bool:
    """Return whether each stored segment is in the index, or waits for it."""
    return connection.execute("SELECT FROM complete").fetchone() is not None


def note_complete(connection: Connection) -> None:
    connection.execute("INSERT INTO complete VALUES (true) ON CONFLICT DO NOTHING")


_LOCKS_OF_A_DAY = 12  # of its partition and the partition's indexes
_LOCKS = """
    SELECT (SELECT count(*) FROM pg_inherits WHERE inhparent = 'record'::regclass),
        current_setting('max_locks_per_transaction')::int, current_setting('max_connections')::int
"""


def too_few_locks(connection: Connection, searches: int) -> str:
    """Return why this number of simultaneous searches of all days would fail, or ""."""
    for days, locks, connections in connection.execute(_LOCKS):
        needed = -(-searches * _LOCKS_OF_A_DAY * days // connections)
        if locks < needed:
            return (
                f"searches of all {days} days of the index may fail: set max_locks_per_transaction of PostgreSQL to"
                f" {2 * needed}, or keep fewer days (retention.index_days)"
            )
    return ""


def migrate(connection: Connection, folder: Path = MIGRATIONS) -> list[str]:
    applied: list[str] = []
    with connection.transaction():
        connection.execute("SELECT pg_advisory_xact_lock(%s)", (_MIGRATION_LOCK,))
        connection.execute(
            "CREATE TABLE IF NOT EXISTS migration (name text PRIMARY KEY, applied timestamptz NOT NULL DEFAULT now())"
        )
        known = {name for (name,) in connection.execute("SELECT name FROM migration")}
        for file in sorted(folder.glob("[0-9]*.sql")):
            if file.stem not in known:
                # The text is a file of this package, never input.
                connection.execute(file.read_bytes())
                connection.execute("INSERT INTO migration (name) VALUES (%s)", (file.stem,))
                applied.append(file.stem)
    if applied:
        _log.info("the database was migrated", applied=applied)
    return applied
