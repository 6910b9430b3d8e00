"""The state file of a standby: it takes changes and snapshots from the active appliance, each in one transaction.

The active appliance is authenticated, but not trusted. It can put and delete rows of the known tables, with
values of the right types; it cannot send SQL, a database file, a trigger, or rows of another table. The file
cannot grow beyond `LARGEST_STATE`. Changes must follow each other without a gap, and none is accepted from a
smaller epoch.

A stored change survives the death of all processes, but not a power cut before the next `sync`. So after a power
cut, a standby must catch up before it takes over. After a `sync` that failed, nothing is stored until one succeeds.
Then a snapshot is needed, because the kernel may have dropped the changes that it could not write.

All tables are copied: tokens are there only as hashes, and the robot's nodes expect `parameters` from either
appliance. Private keys are never in this database.
"""

import contextlib
import os
import sqlite3
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from appliance.base.counted import counted
from appliance.base.engine_thread import InCaller
from appliance.features.standby.replication_frames import (
    Changes,
    FromActive,
    ReplicationError,
    SnapshotBegin,
    SnapshotEnd,
    SnapshotRows,
    Stored,
)
from appliance.features.standby.summary import MISFIT
from appliance.store.changes import Change, ChangeError
from appliance.store.writer_thread import Database, StoreError

LARGEST_STATE = 1 << 30


class Replica:
    """The state file of a standby. Methods raise `StoreError` and wait for the disk: call them in a thread."""

    def __init__(
        self, path: Path, schema: str, *, failed: Callable[[str], None], largest: int = LARGEST_STATE
    ) -> None:
        self._path = path
        # Opening writes the changes that a killed process left; `failed` is called if they cannot be written.
        database = Database(path, schema, failed=failed, drive=InCaller)
        database.close()
        self._tables = database.tables
        self._lock = threading.Lock()
        self._snapshot: SnapshotBegin | None = None
        self._rows = 0
        self.unsynced = ""
        """Why the last `sync` failed, or empty."""
        with self._explain():
            self._connection = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
            self._connection.execute("PRAGMA synchronous=NORMAL")
            (page_size,) = self._connection.execute("PRAGMA page_size").fetchone()
            self._connection.execute(f"PRAGMA max_page_count={largest // page_size}")
            kept = self._connection.execute("SELECT epoch, history, number FROM journal").fetchone()
        self.position = Stored(*kept) if kept else Stored(0, "", 0)

    def take(self, message: FromActive) -> None:
        """Store a message, or leave the state as it was."""
        with self._lock:
            try:
                with self._explain():
                    self._take(message)
            except BaseException:
                self._roll_back()
                raise

    def has_hosts(self) -> bool:
        with self._lock, self._explain():
            query = "SELECT EXISTS (SELECT 1 FROM host WHERE revoked IS NULL)"
            return bool(self._connection.execute(query).fetchone()[0])

    def setting(self, name: str) -> str:
        with self._lock, self._explain():
            found = self._connection.execute("SELECT value FROM setting WHERE name = ?", (name,)).fetchone()
            return str(found[0]) if found else ""

    def sync(self) -> None:
        try:
            with self._path.with_name(f"{self._path.name}-wal").open("rb") as log:
                os.fsync(log.fileno())
        except OSError as error:
            self.unsynced = f"{self._path} cannot be written to the disk: {error}"
            raise StoreError(self.unsynced) from error
        if self.unsynced:
            with self._lock:
                self.unsynced, self.position = "", Stored(self.position.epoch, "", 0)

    def abandon_snapshot(self) -> None:
        with self._lock:
            self._roll_back()

    def close(self) -> None:
        with self._lock:
            self._roll_back()
            self._connection.close()

    def _take(self, message: FromActive) -> None:
        if self.unsynced:
            raise StoreError(self.unsynced)
        match message:
            case SnapshotRows() if self._snapshot is not None:
                self._execute(message.rows)
                self._rows += sum(len(put.rows) for put in message.rows)
            case SnapshotEnd(rows) if self._snapshot is not None:
                if rows != self._rows:
                    raise ReplicationError(
                        f"the snapshot has {counted(self._rows, 'row')}, but should have {rows}"
                    )
                begin = self._snapshot
                self._commit(Stored(begin.epoch, begin.history, begin.number))
                self._snapshot = None
            case Changes() if self._snapshot is None:
                self._require_epoch(message.epoch)
                self._apply(message)
            case SnapshotBegin() if self._snapshot is None:
                self._require_epoch(message.epoch)
                self._connection.execute("BEGIN IMMEDIATE")
                for table in self._tables:
                    self._connection.execute(f"DELETE FROM {table}")  # noqa: S608  a table of the schema
                self._snapshot, self._rows = message, 0
            case _:
                raise ReplicationError(f"{type(message).__name__} is out of order")

    def _require_epoch(self, epoch: int) -> None:
        if epoch < self.position.epoch:
            raise ReplicationError(f"epoch {epoch} has ended: epoch {self.position.epoch} has begun")

    def _apply(self, message: Changes) -> None:
        epoch, history, number = self.position.epoch, self.position.history, self.position.number
        if message.history != history:
            raise ReplicationError("changes of another history need a snapshot first")
        if message.first != number + 1:
            raise ReplicationError(f"change {message.first} does not follow change {number}")
        if message.changes or message.epoch > epoch:
            self._connection.execute("BEGIN IMMEDIATE")
            self._execute(message.changes)
            self._commit(Stored(message.epoch, history, number + len(message.changes)))

    def _execute(self, changes: Sequence[Change]) -> None:
        for change in changes:
            self._tables.check(change)
            self._connection.execute(*self._tables.statement(change))

    def _commit(self, position: Stored) -> None:
        row = (position.epoch, position.history, position.number)
        self._connection.execute("INSERT OR REPLACE INTO journal VALUES (1, ?, ?, ?)", row)
        self._connection.execute("COMMIT")
        self.position = position

    def _roll_back(self) -> None:
        self._snapshot = None
        if self._connection.in_transaction:
            self._connection.execute("ROLLBACK")

    @contextlib.contextmanager
    def _explain(self) -> Iterator[None]:
        try:
            yield
        except (ChangeError, sqlite3.IntegrityError) as error:
            raise ReplicationError(f"{MISFIT}: {error}") from error
        except sqlite3.Error as error:
            raise StoreError(f"{self._path}: {error}; free space there") from error
