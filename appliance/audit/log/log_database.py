"""Create the log's database file, and open it for writing or reading.

A new log gets its name when it is complete, so an empty or cut file is an error, and left unchanged.
"""

import os
import secrets
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from urllib.parse import quote

from appliance.audit.log.columns import StoredColumns
from appliance.base.atomic_files import name_to_make

APPLICATION_ID = 0x52565541  # "RVUA"
LAYOUT_VERSION = 2
_BUSY_SECONDS = 5.0

TABLES = (
    "CREATE TABLE log (id TEXT NOT NULL, begun INTEGER NOT NULL) STRICT",
    "CREATE TABLE record (sequence INTEGER PRIMARY KEY, id TEXT NOT NULL, time INTEGER NOT NULL,"
    " version INTEGER NOT NULL, event TEXT NOT NULL, severity TEXT NOT NULL, decision TEXT, host TEXT,"
    " caller_id TEXT, category TEXT, resource TEXT, rule TEXT, rule_key TEXT, rule_file TEXT,"
    " rule_line INTEGER, revision INTEGER, reason TEXT NOT NULL, duration_us INTEGER, detail BLOB NOT NULL,"
    " hash BLOB NOT NULL) STRICT",
    "CREATE TABLE checkpoint (number INTEGER PRIMARY KEY, sequence INTEGER NOT NULL, text BLOB NOT NULL,"
    " signature BLOB, public_key BLOB) STRICT",
    "CREATE TABLE open_fold (key BLOB PRIMARY KEY, state BLOB NOT NULL) STRICT",
    "CREATE TABLE indexed (through INTEGER NOT NULL) STRICT",
    "CREATE VIRTUAL TABLE words USING fts5(text, tokenize='trigram', content='', detail=none, columnsize=0)",
    "CREATE INDEX record_id ON record (id)",
    "CREATE INDEX record_time ON record (time)",
    "CREATE INDEX record_event ON record (event)",
    "CREATE INDEX record_severity ON record (severity)",
    "CREATE INDEX record_decision ON record (decision) WHERE decision IS NOT NULL",
    "CREATE INDEX record_host ON record (host) WHERE host IS NOT NULL",
    "CREATE INDEX record_caller_id ON record (caller_id) WHERE caller_id IS NOT NULL",
    "CREATE INDEX record_category ON record (category) WHERE category IS NOT NULL",
    "CREATE INDEX record_resource ON record (resource) WHERE resource IS NOT NULL",
    "CREATE INDEX record_rule ON record (rule, rule_key) WHERE rule IS NOT NULL",
    "CREATE INDEX checkpoint_unsigned ON checkpoint (number) WHERE signature IS NULL",
)

_FOR_WRITING = (
    "PRAGMA journal_mode = WAL",
    "PRAGMA synchronous = FULL",
    "PRAGMA journal_size_limit = 67108864",
    "PRAGMA temp_store = MEMORY",
    "PRAGMA cache_size = -16384",
    "PRAGMA wal_autocheckpoint = 4000",  # 16 MB: a robot's start writes the same pages again and again
)
COLUMNS = ", ".join(StoredColumns._fields)
TEXT_OF_RECORD = (
    "coalesce(host, '') || ' ' || coalesce(caller_id, '') || ' ' || coalesce(resource, '') || ' ' ||"
    " coalesce(rule, '') || ' ' || reason || ' ' || CAST(detail AS TEXT)"
)


class LogUnreadableError(Exception):
    """A log file is missing, damaged or foreign."""


def create(path: Path, begun: int) -> None:
    """Create a log that the group of the folder may read; `begun` is nanoseconds since the epoch."""
    making = name_to_make(path)
    making.touch(0o600, exist_ok=False)
    try:
        making.chmod(0o640)
        with closing(sqlite3.connect(making, isolation_level=None)) as connection, connection:
            connection.execute("PRAGMA auto_vacuum = INCREMENTAL")
            connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            connection.execute(f"PRAGMA user_version = {LAYOUT_VERSION}")
            connection.execute("BEGIN")
            for statement in TABLES:
                connection.execute(statement)
            connection.execute("INSERT INTO log VALUES (?, ?)", (secrets.token_hex(16), begun))
            connection.execute("INSERT INTO indexed VALUES (0)")
        # Unlike rename(), link() does not replace a log that another process has created.
        os.link(making, path)
    finally:
        making.unlink()


def open_for_writing(path: Path) -> sqlite3.Connection:
    """Return a connection that commits durably. Raises `LogUnreadableError` and `sqlite3.Error`."""
    connection = _connect(path, "rw", _FOR_WRITING)
    mode = connection.execute("PRAGMA journal_mode").fetchone()[0]
    if mode != "wal":
        connection.close()
        raise sqlite3.OperationalError(f"the file system has no write-ahead log (journal mode is {mode})")
    return connection


def open_for_reading(path: Path) -> sqlite3.Connection:
    """Return a connection that only reads. Raises `LogUnreadableError` and `sqlite3.Error`."""
    if not path.parent.is_dir():
        raise LogUnreadableError(
            f"{path.parent.parent} is not a state directory (--state): it has no folder {path.parent.name}"
        )
    try:
        if not path.exists():
            raise LogUnreadableError(
                f"{path}: there is no audit log yet; is the state directory right (--state)?"
            )
    except PermissionError as error:
        raise LogUnreadableError(f"{path}: {error.strerror}; run as root or as the log's owner") from error
    if not os.access(path, os.R_OK):
        raise LogUnreadableError(f"{path}: permission denied; run as root or as the log's owner")
    for file in (path, *(path.with_name(path.name + end) for end in ("-wal", "-shm", "-journal"))):
        if file.exists() and not file.is_file():  # a pipe has no end
            raise LogUnreadableError(f"{file}: not a regular file; keep it as evidence")
    mode = "ro"
    if not os.access(path.parent, os.W_OK) and not path.with_name(path.name + "-shm").exists():
        mode = "ro&immutable=1"  # a copy on a read-only medium does not change
    return _connect(path, mode, ())


@contextmanager
def reading(path: Path, advice: str = "; run 'rosrv audit verify'") -> Iterator[sqlite3.Connection]:
    """Yield a connection that only reads. Raises `LogUnreadableError`, even for SQLite's errors in the block."""
    try:
        with closing(open_for_reading(path)) as connection:
            yield connection
    except sqlite3.Error as error:
        raise LogUnreadableError(f"{path}: cannot be read: {error}{advice}") from error


def _connect(path: Path, mode: str, settings: Iterable[str]) -> sqlite3.Connection:
    """Return a connection with these settings to a database that is a log."""
    connection = sqlite3.connect(
        f"file:{quote(str(path.absolute()))}?mode={mode}",
        uri=True,
        isolation_level=None,
        timeout=_BUSY_SECONDS,
        check_same_thread=False,
        cached_statements=128,  # an INSERT for each number of rows up to 64, and others
    )
    with ExitStack() as failed:
        failed.callback(connection.close)
        try:
            kind = connection.execute("PRAGMA application_id").fetchone()[0]
            version = connection.execute("PRAGMA user_version").fetchone()[0]
            if kind != APPLICATION_ID:
                raise LogUnreadableError(
                    f"{path}: not an audit log, or one that was cut; see 'rosrv audit verify'"
                )
            if version == 1:
                raise LogUnreadableError(
                    f"{path}: written by version 0.1.0 of rosrv; start version 0.2.0 on it once"
                )
            if version != LAYOUT_VERSION:
                raise LogUnreadableError(
                    f"{path}: written by another version of rosrv (layout {version}): use that version"
                )
            for setting in settings:
                connection.execute(setting)
            # An error may quote bytes of the schema. A view has rows without an end.
            views = connection.execute("SELECT name FROM sqlite_schema WHERE type = 'view'").fetchall()
            if views:
                names = ", ".join(str(name) for (name,) in views)
                raise LogUnreadableError(
                    f"{path}: has the view {names}, which no log has; keep it as evidence"
                )
        except sqlite3.OperationalError:
            raise
        except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
            raise LogUnreadableError(
                f"{path}: damaged: {error}; keep it as evidence and move it away"
            ) from error
        failed.pop_all()
    return connection
