"""Write one SQLite file: changes are queued, written in groups by one thread, and can be awaited.

A killed process loses no change: a separate file holds queued changes until the database has them (`ahead`). A
power failure loses no change that was awaited (`until_settled`). The table `journal` has the number of the last change,
so after a crash the database neither repeats nor skips a change. Numbers identify changes within a *history*
only, which each process begins with its first change, because an earlier process may have passed on changes that
it then lost in a crash. The changes that a killed process left belong to its own history.
"""

import asyncio
import contextlib
import math
import os
import secrets
import sqlite3
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import structlog

from appliance.base.engine_thread import Drive, EngineThread
from appliance.base.full_disk import reason_of
from appliance.store.change_feed import ChangeFeed
from appliance.store.changes import (
    Change,
    ChangeError,
    Condition,
    Delete,
    Encoded,
    Put,
    Tables,
    Value,
    WriteAhead,
    join,
)

_GROUP = 2_000
_GATHER_SECONDS = 0.2  # time to gather changes that are not awaited: they are safe in `ahead`

_RETRY_SECONDS = 0.5
_CATCH_UP_SECONDS = 1.0
_SETTLE_SECONDS = 2 * _RETRY_SECONDS  # a disk that fails for longer is reported, with the reason
_ROOM = 4 << 20  # bytes; SQLite's write-ahead log grows to this size, and few texts are longer

_LEFT = "changes in the file state.ahead are applied at the next start; other changes are lost"

_log = structlog.get_logger()


_JOURNAL = """
CREATE TABLE IF NOT EXISTS journal (
    id INTEGER PRIMARY KEY CHECK (id = 1), epoch INTEGER NOT NULL, history TEXT NOT NULL, number INTEGER NOT NULL
);
"""
_NOTE_NUMBER = (
    "INSERT INTO journal VALUES (1, 0, ?, ?)"
    " ON CONFLICT (id) DO UPDATE SET history = excluded.history, number = excluded.number"
)
_BEFORE_0_4 = """
    SELECT EXISTS (SELECT 1 FROM policy_revision) AND NOT EXISTS (SELECT 1 FROM setting WHERE name = 'ends')
"""


class _Queued(NamedTuple):
    """Changes that are written in one transaction, and the number of the last."""

    number: int
    changes: list[Change]


class _Waiter(NamedTuple):
    """`tell(problem)` is called once the changes before it are written; `problem` is why they are not on the disk."""

    tell: Callable[[str], None]
    synced: bool


class _Gathered(threading.local):
    """The changes of this thread that wait for the end of a block."""

    changes: list[tuple[Change, bool]] | None = None


class StoreError(Exception):
    """The state cannot be read or written."""


def require_0_4(query: Callable[[str], Iterable[tuple[object, ...]]]) -> None:
    """Raise `StoreError` for the state of a version before 0.4, whose ends are not in the table."""
    if list(query(_BEFORE_0_4)) != [(0,)]:
        raise StoreError(
            "the state was made by a version before 0.4: install 0.4.1, start it once, then install this version"
        )


class Database:
    """The state file at `path`, created with `schema` when it is new. Raises `StoreError`.

    `failed` is called once when writing fails (a full disk); the write is repeated until the database is closed.
    """

    def __init__(
        self, path: Path, schema: str, *, failed: Callable[[str], None], drive: Drive = EngineThread
    ) -> None:
        self._path = path
        self._failed = failed
        self._failing = ""
        self._told: set[str] = set()
        self.tables = Tables(schema)
        self.history = secrets.token_hex(8)
        self._encoder = msgspec.msgpack.Encoder()
        # `.ahead` exists once the database has tables. SQLite would take an empty file for new, and lose revocations.
        if path.exists() and not path.stat().st_size and path.with_suffix(".ahead").exists():
            raise StoreError(
                f"{path}: is empty, but was not when the appliance last ran: restore a backup (rosrv restore), or"
                " move the file away to start with an empty state"
            )
        try:
            self._connection = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
            self._connection.execute("PRAGMA journal_mode=WAL")
            self._connection.execute("PRAGMA synchronous=NORMAL")
            self._connection.executescript(schema + _JOURNAL)
            self._ahead = WriteAhead(path.with_suffix(".ahead"))
            self._number = self._catch_up()  # of the last change
        except sqlite3.Error as error:
            raise StoreError(f"{path}: {reason_of(error, path.parent)}; {_advice(error)}") from error
        except (OSError, ValueError, ChangeError) as error:
            raise StoreError(f"{path.with_suffix('.ahead')}: {error}") from error
        self._feeds: tuple[ChangeFeed, ...] = ()
        self._gathered = _Gathered()
        self._queue: deque[_Queued | _Waiter] = deque()
        self._group: list[_Queued | _Waiter] = []
        self._retry_at = -math.inf
        self._order = threading.Lock()  # for equal order in the write-ahead file and the queue
        self._closed = False  # no further changes
        self._ended = False  # no further turns
        self._driver = drive("store", self.turn, _GATHER_SECONDS)

    def query(self, sql: str, parameters: Sequence[Value] = ()) -> list[tuple[Any, ...]]:
        """Return rows, including queued ones. Call this in a thread, because it may wait for `_CATCH_UP_SECONDS`."""
        if not self._ended and not self._failing:
            written = threading.Event()
            self._queue.append(_Waiter(lambda _problem: written.set(), synced=False))
            self._driver.hurry()
            written.wait(_CATCH_UP_SECONDS)
        try:
            with contextlib.closing(sqlite3.connect(self._path)) as reader:
                return reader.execute(sql, parameters).fetchall()
        except sqlite3.Error as error:
            raise StoreError(f"{self._path}: {error}") from error

    def put(self, table: str, *row: Value, ahead: bool = True) -> None:
        """Store a row. With `ahead`, it survives an end of the process as soon as this returns.

        Raises `ChangeError` and `StoreError`.
        """
        self._submit(Put(table, [row]), ahead=ahead)

    def delete(self, table: str, *conditions: Condition, ahead: bool = True, **equal: Value) -> None:
        equals: list[Condition] = [(column, "=", value) for column, value in equal.items()]
        self._submit(Delete(table, [*conditions, *equals]), ahead=ahead)

    def _submit(self, change: Change, *, ahead: bool) -> None:
        self.tables.check(change)
        if self._gathered.changes is None:
            self.keep([(change, ahead)])
        else:
            self._gathered.changes.append((change, ahead))

    @contextlib.contextmanager
    def together(self) -> Iterator[None]:
        """Write this thread's changes in the block together at its end; none survives the process before."""
        if self._gathered.changes is not None:
            yield
            return
        gathered = self._gathered.changes = []
        try:
            yield
        finally:
            self._gathered.changes = None
            if gathered:
                self.keep(gathered)

    def keep(self, changes: list[tuple[Change, bool]]) -> None:
        encoded = [
            (change, ahead, self._encoder.encode(change) if ahead or self._feeds else b"")
            for change, ahead in join(changes)
        ]
        with self._order:
            self._require_open()
            first = self._number + 1
            self._number += len(encoded)
            kept = [Encoded(number, body) for number, (_, ahead, body) in enumerate(encoded, first) if ahead]
            if kept:
                try:
                    self._ahead.append(kept)
                except OSError as error:
                    self._fail(f"{self._path.with_suffix('.ahead')}: {error}")
            self._queue.append(_Queued(self._number, [change for change, _, _ in encoded]))
            for feed in self._feeds:
                bodies = [body or self._encoder.encode(change) for change, _, body in encoded]
                feed.add([Encoded(number, body) for number, body in enumerate(bodies, first)])
        self._driver.wake()

    def follow(self, changed: Callable[[], None], room: int) -> ChangeFeed:
        with self._order:
            feed = ChangeFeed(self._number, changed, room)
            self._feeds = (*self._feeds, feed)
        return feed

    def unfollow(self, feed: ChangeFeed) -> None:
        with self._order:
            self._feeds = tuple(other for other in self._feeds if other is not feed)

    @property
    def number(self) -> int:
        return self._number

    def copy(self) -> sqlite3.Connection:
        """Return a copy in a file that no longer has a name; call this in a thread.

        The copy is one step: with fewer pages at a time, each commit would start it again.
        """
        path = self._path.with_suffix(".new")
        path.unlink(missing_ok=True)  # a killed process may have left a part
        copy = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
        try:
            copy.execute("PRAGMA journal_mode=OFF")
            copy.execute("PRAGMA synchronous=OFF")
            with contextlib.closing(sqlite3.connect(self._path)) as source:
                source.backup(copy)
            copy.execute("PRAGMA journal_mode=OFF")  # the source's mode was copied with it
        except sqlite3.Error as error:
            copy.close()
            raise StoreError(f"{path}: {reason_of(error, path.parent)}; {_advice(error)}") from error
        finally:
            path.unlink(missing_ok=True)
        return copy

    def _require_open(self) -> None:
        if self._closed:
            raise StoreError(
                f"{self._path}: the appliance is stopping, and this change came too late to be saved"
            )

    def require_room(self) -> None:
        """Raise `StoreError` if the disk is too full for an order's changes; the order must then change nothing."""
        disk = os.statvfs(self._path.parent)
        free = disk.f_bavail * disk.f_frsize
        if self._failing or free < _ROOM:
            why = self._failing or f"{self._path}: {free} bytes are free on its disk, {_ROOM} are wanted"
            raise StoreError(f"{why}; nothing was changed: free space and try again")

    async def until_settled(self) -> None:
        """Wait until the changes queued so far are on the disk. Raises `StoreError` if they cannot be written."""
        if problem := await self.unwritten():
            raise StoreError(
                f"{problem}; free space: until then a restart undoes recent changes"
                if problem == self._failing
                else f"{problem}; a power failure may undo recent changes: check the disk"
            )

    async def unwritten(self) -> str:
        """Wait until the changes queued so far are on the disk; return why they are not, or an empty text.

        Raises `StoreError` after `close`.
        """
        loop = asyncio.get_running_loop()
        done: asyncio.Future[str] = loop.create_future()

        def tell(problem: str) -> None:
            if not done.done():
                done.set_result(problem)

        def call_back(problem: str) -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended, so no caller waits
                loop.call_soon_threadsafe(tell, problem)

        with self._order:
            self._require_open()
            self._queue.append(_Waiter(call_back, synced=True))
        self._driver.hurry()
        while not (await asyncio.wait([done], timeout=_SETTLE_SECONDS))[0]:
            if self._failing:
                return self._failing
        return done.result()

    def close(self, seconds: float | None = None) -> None:
        """Write the queue within `seconds` (None: no limit). Changes made after this call begins raise
        `StoreError`.
        """
        with self._order:
            self._closed = True
        if not self._driver.end(seconds):
            self._failed(f"{self._path}: still being written after {seconds:g} s; {_LEFT}")
            return
        self._connection.close()
        self._ahead.close()

    def turn(self, now: float) -> float | None:
        if self._ended:
            return None
        if now < self._retry_at and not self._closed:
            return self._retry_at
        due = None
        try:
            due = self._turn(now)
        except BaseException as error:
            # A defect: callers that wait get the error, and orders are refused, until a turn succeeds. Otherwise the
            # next start applies the changes.
            self._failing = f"{self._path}: writing ended: {type(error).__name__}: {error}"
            if self._closed or not isinstance(error, Exception):
                self._fail(self._failing)
                raise
            if self._failing not in self._told:
                _log.error("fault in the writer of the state, which tries again", exc_info=error)
            self._fail(self._failing)
            self._roll_back()
            due = self._retry_at = now + _RETRY_SECONDS
        finally:
            self._ended = due is None
        return due

    def _turn(self, now: float) -> float | None:
        closed = self._closed  # the queue has everything that was changed before
        group = self._group
        while self._queue and len(group) < _GROUP:
            group.append(self._queue.popleft())
        changes = [item for item in group if isinstance(item, _Queued)]
        if changes and not self._commit(changes):
            if not closed:
                self._retry_at = now + _RETRY_SECONDS
                return self._retry_at
            self._fail(f"{self._failing}; {_LEFT}")
            return None
        waiters = [item for item in group if isinstance(item, _Waiter)]
        problem = self._sync() if any(waiter.synced for waiter in waiters) else ""
        for waiter in waiters:
            waiter.tell(problem)
        group.clear()
        if self._queue:
            return now
        return None if closed else math.inf

    def _commit(self, queued: list[_Queued]) -> bool:
        last = queued[-1].number
        try:
            statement = self.tables.statement
            statements = [statement(change) for item in queued for change in item.changes]
            self._execute(statements, self.history, last)
        except sqlite3.Error as error:
            self._roll_back()
            self._failing = f"{self._path}: {reason_of(error, self._path.parent)}"
            self._fail(self._failing)
            return False
        self._failing = ""
        try:
            self._ahead.stored(last)
        except OSError as error:  # the database has these changes, so the next start skips them
            self._fail(f"{self._path.with_suffix('.ahead')}: {error}")
            return True
        if self._told:
            _log.warning("state is written again", file=str(self._path))
            self._told.clear()
        return True

    def _roll_back(self) -> None:
        if self._connection.in_transaction:
            with contextlib.suppress(sqlite3.Error):  # the next BEGIN reports it
                self._connection.execute("ROLLBACK")

    def _sync(self) -> str:
        """Flush to the disk; return why this failed. The kernel may then have dropped data that it could not write."""
        try:
            with self._path.with_name(f"{self._path.name}-wal").open("rb") as log:
                os.fsync(log.fileno())
            self._ahead.sync()  # else a power failure could leave a part of it
        except OSError as error:
            problem = f"{self._path}: {error}"
            self._fail(problem)
            return problem
        return ""

    def _fail(self, reason: str) -> None:
        if reason not in self._told:
            self._told.add(reason)
            self._failed(reason)

    def _execute(self, statements: list[tuple[str, list[Value]]], history: str, number: int) -> None:
        self._connection.execute("BEGIN")
        for sql, values in statements:
            self._connection.execute(sql, values)
        self._connection.execute(_NOTE_NUMBER, (history, number))
        self._connection.execute("COMMIT")

    def _catch_up(self) -> int:
        """Apply the changes that a killed process left, before anything is read; return the last number."""
        kept = self._connection.execute("SELECT history, number FROM journal").fetchone()
        number = kept[1] if kept else 0
        left = self._ahead.changes_after(number)
        history = kept[0] if kept and left.goes_on else self.history
        for _number, change in left.changes:
            self.tables.check(change)
        if left.changes:
            number = left.changes[-1][0]
            statements = [self.tables.statement(change) for _number, change in left.changes]
            self._execute(statements, history, number)
        self._ahead.clear()
        return number


def _advice(error: sqlite3.Error) -> str:
    # Subclasses report the environment (a full disk, a lock, rights); the class itself reports wrong content.
    if type(error) is sqlite3.DatabaseError:
        return "move the file away to start with an empty state"
    return "free space there and make it writable, or name another directory with --state DIR"
