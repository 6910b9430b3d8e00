import asyncio
import contextlib
import errno
import math
import os
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NoReturn

import msgspec
import pytest

from appliance.base import clock
from appliance.store import writer_thread
from appliance.store.change_feed import ChangeFeed
from appliance.store.changes import (
    Change,
    ChangeError,
    Delete,
    Encoded,
    Put,
    Tables,
    WriteAhead,
    WriteAheadClosedError,
    join,
)
from appliance.store.writer_thread import Database, StoreError
from tests.support.engines import ByHand, let_pass
from tests.support.small_disk import small_disk
from tests.support.virtual_clock import VirtualClock
from tests.support.waiting import eventually

pytestmark = pytest.mark.anyio

KILLED = """
import os, signal, sys
from pathlib import Path
from appliance.store.writer_thread import Database
database = Database(Path(sys.argv[1]) / "state.db", sys.argv[2], failed=print)
for number in range(5000):
    database.put("thing", "last", number)
    database.put("thing", "row " + str(number), 1)
with database.together():
    for number in range(100):
        with database.together():
            database.put("thing", "together " + str(number), 1)
os.kill(os.getpid(), signal.SIGKILL)
"""
SCHEMA = "CREATE TABLE IF NOT EXISTS thing (name TEXT PRIMARY KEY, size INTEGER);"


def encoded(number: int, name: str) -> Encoded:
    return Encoded(number, msgspec.msgpack.encode(Put("thing", [(name, number)])))


@pytest.fixture
def failures() -> list[str]:
    return []


@pytest.fixture
def database(tmp_path: Path, failures: list[str]) -> Iterator[Database]:
    database = Database(tmp_path / "state.db", SCHEMA, failed=failures.append, drive=ByHand)
    yield database
    database.close()


@pytest.fixture
def appended(monkeypatch: pytest.MonkeyPatch) -> list[Sequence[Encoded]]:
    """Return the changes of each write to the file of statements on their way."""
    appended: list[Sequence[Encoded]] = []
    append = WriteAhead.append

    def observed(ahead: WriteAhead, changes: Sequence[Encoded]) -> None:
        appended.append(changes)
        append(ahead, changes)

    monkeypatch.setattr(WriteAhead, "append", observed)
    return appended


def test_closing_writes_what_is_left(tmp_path: Path) -> None:
    database = Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail, drive=ByHand)
    for number in range(3000):
        database.put("thing", str(number), 1)
    database.close()
    again = Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail, drive=ByHand)
    assert again.query("SELECT count(*) FROM thing") == [(3000,)]
    again.close()


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sqlite3, "connect", partial(sqlite3.connect, timeout=0))


def test_a_write_that_fails_is_tried_again_until_it_succeeds(
    impatient: None, tmp_path: Path, failures: list[str]
) -> None:
    database = Database(tmp_path / "state.db", SCHEMA, failed=failures.append, drive=ByHand)
    blocker = sqlite3.connect(tmp_path / "state.db", isolation_level=None)
    blocker.execute("BEGIN EXCLUSIVE")
    database.put("thing", "late", 1)
    assert database.turn(0) == 0.5
    database.put("thing", "later", 2)
    assert database.turn(0.4) == 0.5  # it is not tried again with each change
    assert database.turn(0.5) == 1.0
    assert [("locked" in failure) for failure in failures] == [True]
    blocker.execute("COMMIT")
    blocker.close()
    assert database.query("SELECT name FROM thing") == []
    assert database.turn(1.0) == math.inf
    assert database.query("SELECT name FROM thing") == [("late",), ("later",)]
    database.close()


async def test_changes_that_cannot_be_written_at_the_end_are_reported(
    impatient: None, tmp_path: Path, failures: list[str]
) -> None:
    database = Database(tmp_path / "state.db", SCHEMA, failed=failures.append, drive=ByHand)
    blocker = sqlite3.connect(tmp_path / "state.db", isolation_level=None)
    blocker.execute("BEGIN EXCLUSIVE")
    database.put("thing", "late", 1)
    waiting = asyncio.ensure_future(database.until_settled())
    await asyncio.sleep(0)
    database.close()
    await asyncio.wait([waiting], timeout=0)
    assert not waiting.done()
    waiting.cancel()
    assert "applied at the next start" in failures[-1]
    blocker.close()
    again = Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail, drive=ByHand)
    assert again.query("SELECT name FROM thing") == [("late",)]
    again.close()


@pytest.mark.nightly
async def test_a_thread_writes_changes(tmp_path: Path) -> None:
    database = Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail)
    database.put("thing", "a", 1)
    await database.until_settled()
    with sqlite3.connect(tmp_path / "state.db") as other:
        assert other.execute("SELECT name FROM thing").fetchall() == [("a",)]
        database.put("thing", "b", 1)
        eventually(lambda: other.execute("SELECT name FROM thing WHERE name = 'b'").fetchall(), "it is there")
    database.close()


@pytest.mark.nightly
def test_a_waiting_caller_learns_that_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("appliance.store.writer_thread._SETTLE_SECONDS", 0)
    with small_disk(tmp_path / "disk", "1m") as place:
        failures: list[str] = []
        database = Database(place / "state.db", SCHEMA, failed=failures.append, drive=ByHand)
        filler = place / "filler"
        with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
            while file.write(bytes(4096)):
                pass

        async def scene() -> None:
            database.put("thing", "late", 1)
            with pytest.raises(StoreError, match=r"state\.db: .*full; free space"):
                await database.until_settled()
            filler.unlink()
            let_pass(database, 1)
            await database.until_settled()

        passing = VirtualClock()
        with clock.using(passing):
            asyncio.run(scene())
        assert database.query("SELECT name FROM thing") == [("late",)]
        database.close()


async def test_callers_learn_of_a_defect_until_it_has_passed(
    tmp_path: Path, failures: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("appliance.store.writer_thread._SETTLE_SECONDS", 0)

    def defect(_tables: Tables, _change: Change) -> NoReturn:
        raise RuntimeError("unforeseen")

    database = Database(tmp_path / "state.db", SCHEMA, failed=failures.append, drive=ByHand)
    with monkeypatch.context() as broken:
        broken.setattr(Tables, "statement", defect)
        database.put("thing", "a", 1)
        assert database.turn(clock.now()) is not None, "the thread must not end"
        with pytest.raises(StoreError, match="writing ended: RuntimeError: unforeseen"):
            await database.until_settled()
        with pytest.raises(StoreError, match="nothing was changed"):
            database.require_room()
    let_pass(database, 1)
    database.require_room()
    await database.until_settled()
    database.close()
    assert failures == [f"{tmp_path / 'state.db'}: writing ended: RuntimeError: unforeseen"]
    again = Database(tmp_path / "state.db", SCHEMA, failed=failures.append, drive=ByHand)
    assert again.query("SELECT name FROM thing") == [("a",)]
    again.close()


async def test_writing_continues_without_the_file_of_changes(
    database: Database, tmp_path: Path, failures: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_descriptor: int, _length: int) -> NoReturn:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "ftruncate", broken)
    for number in range(2):
        database.put("thing", f"row {number}", number)
        await database.until_settled()
    assert database.query("SELECT name FROM thing") == [("row 0",), ("row 1",)]
    assert failures == [f"{tmp_path / 'state.ahead'}: [Errno 5] Input/output error"]


async def test_settled_statements_survive_a_power_failure(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[tuple[str, int]] = []
    fsync = os.fsync

    def noted(descriptor: int) -> None:
        fsync(descriptor)
        synced.append((str(Path(f"/proc/self/fd/{descriptor}").readlink()), os.fstat(descriptor).st_size))

    monkeypatch.setattr(os, "fsync", noted)
    database.put("thing", "revoked", 1)
    await database.until_settled()
    log, ahead = tmp_path / "state.db-wal", tmp_path / "state.ahead"
    assert synced == [(str(log), log.stat().st_size), (str(ahead), 0)]


async def test_statements_that_a_power_failure_may_undo_are_not_settled(
    database: Database, tmp_path: Path, failures: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_descriptor: int) -> NoReturn:
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as disk:
        disk.setattr(os, "fsync", broken)
        database.put("thing", "revoked", 1)
        with pytest.raises(StoreError, match=r"state\.db: .*Input/output error; a power failure"):
            await database.until_settled()
        assert failures == [f"{tmp_path / 'state.db'}: [Errno 5] Input/output error"]
        assert database.query("SELECT name FROM thing") == [("revoked",)]
    await database.until_settled()


def test_a_file_that_is_not_a_database_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    file = tmp_path / "state.db"
    file.write_bytes(b"this is not a database" * 100)
    with pytest.raises(StoreError, match=r"state\.db.*move the file away"):
        Database(file, SCHEMA, failed=pytest.fail, drive=ByHand)
    assert file.read_bytes().startswith(b"this is not")


def test_a_file_that_lost_all_it_had_is_not_taken_for_a_new_one(tmp_path: Path) -> None:
    """Otherwise tokens, hosts and revocations would be lost silently. Only before the first start may it be empty."""
    path = tmp_path / "state.db"
    path.touch()
    Database(path, SCHEMA, failed=print, drive=ByHand).close()
    os.truncate(path, 0)
    with pytest.raises(
        StoreError, match=r"state\.db: is empty, but was not .*rosrv restore.* move the file away"
    ):
        Database(path, SCHEMA, failed=print, drive=ByHand)
    path.unlink()
    Database(path, SCHEMA, failed=print, drive=ByHand).close()


def test_an_unwritable_folder_is_not_taken_for_a_bad_file(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"state\.db.*free space") as caught:
        Database(tmp_path / "missing" / "state.db", SCHEMA, failed=pytest.fail, drive=ByHand)
    assert "move" not in str(caught.value)


@pytest.mark.nightly
def test_statements_queued_by_a_killed_process_are_there_after_the_next_start(tmp_path: Path) -> None:
    killed = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path), SCHEMA], check=False, timeout=60)
    assert killed.returncode == -signal.SIGKILL
    again = Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail, drive=ByHand)
    assert again.query("SELECT count(*) FROM thing") == [(5101,)]
    assert again.query("SELECT size FROM thing WHERE name = ?", ("last",)) == [(4999,)]
    again.close()


def test_rows_of_one_table_are_one_statement(
    database: Database, tmp_path: Path, appended: list[Sequence[Encoded]]
) -> None:
    with database.together():
        for size in range(100):
            database.put("thing", f"row {size % 70}", size)
        database.delete("thing", name="row 1")
        database.put("thing", "row 2", 1)
    assert list(map(len, appended)) == [4]  # SQLite limits the number of values in one statement
    asyncio.run(database.until_settled())
    with sqlite3.connect(tmp_path / "state.db") as other:
        rows = dict(other.execute("SELECT name, size FROM thing"))
    expected = {f"row {size % 70}": size for size in range(100)} | {"row 2": 1}
    del expected["row 1"]
    assert rows == expected


@pytest.mark.nightly
def test_a_block_of_one_thread_is_whole_beside_that_of_another(
    database: Database, appended: list[Sequence[Encoded]]
) -> None:
    def other() -> None:
        with database.together():
            database.delete("thing", name="c")
            database.put("thing", "d", 1)
        assert list(map(len, appended)) == [2], "both changes of this block, and none of the other"

    with database.together():
        database.put("thing", "a", 1)
        with ThreadPoolExecutor(1) as pool:
            pool.submit(other).result()
        database.delete("thing", name="b")
    assert list(map(len, appended)) == [2, 2]


def test_a_block_of_statements_is_one_transaction(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_thread, "_GROUP", 1)
    found: list[list[tuple[str]]] = []
    for name in ("first", "second"):
        with database.together():
            database.put("thing", name, 1)
            database.delete("thing", ("size", "<", 1))
            database.put("thing", f"{name} too", 1)
    with contextlib.closing(sqlite3.connect(tmp_path / "state.db")) as other:
        for _turn in range(2):
            database.turn(0)
            found.append(other.execute("SELECT name FROM thing ORDER BY rowid").fetchall())
    assert found == [[("first",), ("first too",)], [("first",), ("first too",), ("second",), ("second too",)]]


@pytest.mark.nightly
def test_a_block_of_statements_is_one_write_and_delays_no_other_thread(
    database: Database, appended: list[Sequence[Encoded]]
) -> None:
    def kept() -> list[list[str]]:
        written = [[msgspec.msgpack.decode(one.body, type=Put) for one in changes] for changes in appended]
        return [[row[0] for put in puts for row in put.rows] for puts in written]

    def submit(name: str) -> None:
        database.put("thing", name, 1)

    with pytest.raises(ValueError, match="amid it"), database.together():
        submit("first")
        other = threading.Thread(target=submit, args=("other",))
        other.start()
        other.join()
        assert kept() == [["other"]]
        submit("second")
        raise ValueError("amid it")
    submit("third")
    assert kept() == [["other"], ["first", "second"], ["third"]]
    assert len(database.query("SELECT name FROM thing")) == 4


def leave_behind(path: Path, *changes: Encoded) -> None:
    ahead = WriteAhead(path)
    for change in changes:
        ahead.append([change])
    ahead.close()


def names_after_start(tmp_path: Path) -> list[str]:
    database = Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail, drive=ByHand)
    names = [name for (name,) in database.query("SELECT name FROM thing ORDER BY name")]
    database.close()
    assert (tmp_path / "state.ahead").stat().st_size == 0
    return names


def test_a_change_torn_by_the_crash_is_left_out(tmp_path: Path) -> None:
    file = tmp_path / "state.ahead"
    leave_behind(file, encoded(1, "whole"))
    whole = file.stat().st_size
    leave_behind(file, encoded(2, "torn"))
    data = file.read_bytes()
    for end in range(whole, len(data)):
        (tmp_path / "state.db").unlink(missing_ok=True)
        file.write_bytes(data[:end])
        assert names_after_start(tmp_path) == ["whole"]


@pytest.mark.parametrize("damage", [b"\x00", b"\xff"])
def test_nothing_behind_a_damaged_change_is_applied(tmp_path: Path, damage: bytes) -> None:
    file = tmp_path / "state.ahead"
    leave_behind(file, encoded(1, "first"))
    begin = file.stat().st_size
    leave_behind(file, encoded(2, "second"))
    end = file.stat().st_size
    leave_behind(file, encoded(3, "third"))
    data = file.read_bytes()
    for size in (1, end - begin):
        for at in range(begin, end - size + 1):
            damaged = data[:at] + damage * size + data[at + size :]
            (tmp_path / "state.db").unlink(missing_ok=True)
            file.write_bytes(damaged)
            expected = ["first", "second", "third"] if damaged == data else ["first"]
            assert names_after_start(tmp_path) == expected


def test_changes_behind_a_missing_one_are_left_out(tmp_path: Path) -> None:
    leave_behind(tmp_path / "state.ahead", encoded(1, "kept"))
    assert names_after_start(tmp_path) == ["kept"]
    ahead = WriteAhead(tmp_path / "state.ahead")
    ahead.append([encoded(2, "lost")])
    ahead.clear()
    ahead.append([encoded(3, "later")])
    ahead.close()
    assert names_after_start(tmp_path) == ["kept"]


def test_changes_that_the_database_has_are_not_repeated(tmp_path: Path) -> None:
    file = tmp_path / "state.ahead"
    leave_behind(file, encoded(1, "a"))
    old = file.read_bytes()
    leave_behind(file, Encoded(2, msgspec.msgpack.encode(Delete("thing", [("name", "=", "a")]))))
    assert names_after_start(tmp_path) == []
    file.write_bytes(old)
    assert names_after_start(tmp_path) == []
    database = Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail, drive=ByHand)
    assert database.number == 2
    database.close()


def test_a_large_value_that_is_lost_takes_no_later_change_with_it(tmp_path: Path) -> None:
    ahead = WriteAhead(tmp_path / "state.ahead")
    ahead.append([encoded(2, "second"), encoded(5, "fifth")])
    ahead.close()
    assert names_after_start(tmp_path) == ["fifth", "second"]


def test_a_change_of_a_later_release_is_an_error_that_names_it(tmp_path: Path) -> None:
    body = msgspec.msgpack.encode(Put("future", [("a", 1)]))
    leave_behind(tmp_path / "state.ahead", Encoded(1, body))
    before = (tmp_path / "state.ahead").read_bytes()
    with pytest.raises(StoreError, match=r"state\.ahead: the state has no table 'future'"):
        Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail, drive=ByHand)
    assert (tmp_path / "state.ahead").read_bytes() == before


def test_a_change_that_fits_no_table_is_refused_at_once(database: Database) -> None:
    database.put("thing", "before", 1)
    with pytest.raises(ChangeError, match="a row of thing has 2 values, not 3"):
        database.put("thing", "bad", 1, 2)
    with pytest.raises(ChangeError, match="thing has no column 'colour'"):
        database.delete("thing", colour="red")
    database.put("thing", "after", 1)
    assert database.query("SELECT name FROM thing ORDER BY rowid") == [("before",), ("after",)]


@pytest.mark.nightly
def test_a_feed_has_all_changes_of_the_database_in_its_order(tmp_path: Path) -> None:
    database = Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail)
    database.put("thing", "earlier", 1)
    calls: list[int] = []
    feed = database.follow(lambda: calls.append(1), 1 << 30)
    begin = database.number

    def put(name: int) -> None:
        for number in range(500):
            database.put("thing", f"row {number % 50}", name * number, ahead=bool(number % 3))

    threads = [threading.Thread(target=put, args=(name,)) for name in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    database.delete("thing", name="row 1")
    assert (begin, database.number, len(calls)) == (1, 2002, 2001)
    changes = feed.after(begin, 1 << 30)
    assert changes is not None
    assert [change.number for change in changes] == list(range(begin + 1, database.number + 1))
    database.unfollow(feed)
    database.put("thing", "later", 1)
    assert feed.after(database.number, 1) is None
    with contextlib.closing(sqlite3.connect(":memory:")) as other:
        other.executescript(SCHEMA)
        other.execute("INSERT INTO thing VALUES ('earlier', 1), ('later', 1)")
        for change in changes:
            other.execute(*Tables.statement(msgspec.msgpack.decode(change.body, type=Change)))
        query = "SELECT * FROM thing ORDER BY name"
        asyncio.run(database.until_settled())
        assert other.execute(query).fetchall() == database.query(query)
    database.close()


def test_a_feed_that_begins_during_a_change_has_the_whole_change(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    feeds: list[ChangeFeed] = []

    def late(changes: Sequence[tuple[Change, bool]]) -> Iterator[tuple[Change, bool]]:
        yield from join(changes)
        feeds.append(database.follow(lambda: None, 1 << 20))

    monkeypatch.setattr(writer_thread, "join", late)
    database.put("thing", "large", 1, ahead=False)
    changes = feeds[0].after(0, 1 << 20)
    assert changes == [Encoded(1, msgspec.msgpack.encode(Put("thing", [("large", 1)])))]


def test_numbers_continue_after_each_start_and_each_start_has_its_own_history(tmp_path: Path) -> None:
    found: list[tuple[str, int]] = []
    for start in range(3):
        database = Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail, drive=ByHand)
        assert database.number == 2 * start
        database.put("thing", "a", start)
        database.put("thing", "b", start)
        found.append((database.history, database.number))
        database.close()
        Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail, drive=ByHand).close()
        with contextlib.closing(sqlite3.connect(tmp_path / "state.db")) as reader:
            assert reader.execute("SELECT history, number FROM journal").fetchall() == found[-1:]
    assert len(set(found)) == 3
    leave_behind(tmp_path / "state.ahead", encoded(7, "left"))
    database = Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail, drive=ByHand)
    query = "SELECT history, number FROM journal"
    assert database.query(query) == [(database.history, 7)]
    assert database.number == 7
    database.close()


@pytest.mark.parametrize("committed", [False, True])
def test_the_changes_that_a_killed_process_left_belong_to_its_history(
    tmp_path: Path, *, committed: bool
) -> None:
    """Unless its first change is among them: the history in the database is then that of an earlier process."""
    earlier = Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail, drive=ByHand)
    earlier.put("thing", "a", 1)
    earlier.close()
    killed = Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail, drive=ByHand)
    killed.put("thing", "b", 1)
    if committed:
        killed.turn(0.0)
    killed.put("thing", "c", 1)
    Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail, drive=ByHand).close()
    with contextlib.closing(sqlite3.connect(tmp_path / "state.db")) as reader:
        ((history, number),) = reader.execute("SELECT history, number FROM journal")
    assert number == 3
    assert (history == killed.history) is committed
    assert history != earlier.history


@pytest.mark.nightly
def test_a_copy_is_of_one_moment_and_leaves_no_file(tmp_path: Path) -> None:
    (tmp_path / "state.new").write_bytes(b"a part")
    database = Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail)
    database.put("thing", "0", 0)
    database.query("SELECT 1")
    ended = threading.Event()

    def put() -> None:
        for number in range(1, 20_000):
            if ended.is_set():
                return
            database.put("thing", str(number), number)

    thread = threading.Thread(target=put)
    thread.start()
    try:
        for _ in range(10):
            copy = database.copy()
            (count,) = copy.execute("SELECT count(*) FROM thing").fetchone()
            assert copy.execute("SELECT number FROM journal").fetchone() == (count,)
            copy.close()
    finally:
        ended.set()
        thread.join(30)
    assert {path.name for path in tmp_path.iterdir()} == {
        "state.db", "state.db-wal", "state.db-shm", "state.ahead"
    }  # fmt: skip
    database.close()


class _Gate:
    def __init__(self) -> None:
        self.writing, self.closing = threading.Event(), threading.Event()
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            self.closing.set()
            self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def write(self, descriptor: int, data: bytes, write: Callable[[int, bytes], int] = os.write) -> int:
        self.writing.set()
        assert self.closing.wait(30)
        return write(descriptor, data)

    def close(self, descriptor: int, close: Callable[[int], None] = os.close) -> None:
        close(descriptor)
        self.other = os.open("another", os.O_RDWR | os.O_CREAT)  # the lowest number that is free
        self.closing.set()


@pytest.mark.nightly
def test_closing_waits_for_a_write_that_is_under_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gate = _Gate()
    monkeypatch.chdir(tmp_path)
    ahead = WriteAhead(tmp_path / "state.ahead")
    monkeypatch.setattr(ahead, "_lock", gate)
    monkeypatch.setattr(os, "write", gate.write)
    monkeypatch.setattr(os, "close", gate.close)
    writing = threading.Thread(target=ahead.append, args=([encoded(1, "a")],))
    writing.start()
    assert gate.writing.wait(30)
    ahead.close()
    writing.join(30)
    monkeypatch.undo()
    os.close(gate.other)
    assert (tmp_path / "another").read_bytes() == b""
    assert (tmp_path / "state.ahead").stat().st_size > 0


def test_a_closed_file_of_statements_refuses_every_use(tmp_path: Path) -> None:
    ahead = WriteAhead(tmp_path / "state.ahead")
    ahead.close()
    with (tmp_path / "another").open("wb") as another:
        another.write(b"untouched")
        another.flush()
        uses: list[Callable[[], None]] = [ahead.clear, ahead.sync, partial(ahead.stored, 0)]
        uses.append(partial(ahead.append, [encoded(1, "a")]))
        for use in uses:
            with pytest.raises(WriteAheadClosedError, match=r"already closed.*state\.ahead"):
                use()
        ahead.close()
    assert (tmp_path / "another").read_bytes() == b"untouched"


@pytest.mark.nightly
def test_a_change_is_kept_or_refused_however_it_meets_the_end(tmp_path: Path) -> None:
    kept: list[str] = []
    database = Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail)
    begin = threading.Barrier(9)

    def submit(name: int) -> None:
        begin.wait(30)
        with contextlib.suppress(StoreError):
            for number in range(3_000):
                row = f"{name} {number}"
                database.put("thing", row, 1, ahead=bool(number % 2))
                kept.append(row)

    threads = [threading.Thread(target=submit, args=(name,)) for name in range(8)]
    for thread in threads:
        thread.start()
    begin.wait(30)
    database.close()
    for thread in threads:
        thread.join(30)
    with pytest.raises(StoreError, match="too late to be saved"):
        asyncio.run(database.until_settled())
    with contextlib.closing(sqlite3.connect(tmp_path / "state.db")) as reader:
        assert {name for (name,) in reader.execute("SELECT name FROM thing")} == set(kept)
