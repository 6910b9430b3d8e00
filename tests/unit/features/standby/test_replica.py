import contextlib
import errno
import os
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.features.standby.replica import Replica
from appliance.features.standby.replication_frames import (
    Changes,
    FromActive,
    ReplicationError,
    SnapshotBegin,
    SnapshotEnd,
    SnapshotRows,
    Stored,
)
from appliance.store.changes import Change, Delete, Encoded, Put, WriteAhead
from appliance.store.state_file import SCHEMA as WHOLE_SCHEMA
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from tests.support.engines import InlineDatabase
from tests.support.features.standby.replication import SCHEMA, tables_of
from tests.support.small_disk import small_disk

BEGIN = SnapshotBegin(3, "h", 7)


def thing(name: str) -> Put:
    return Put("thing", [(name, 1, None)])


def changes(*made: Change, epoch: int = 3, history: str = "h", first: int = 8) -> Changes:
    return Changes(epoch, history, first, list(made))


def begun(tmp_path: Path) -> Replica:
    replica = Replica(tmp_path / "state.db", SCHEMA, failed=pytest.fail, largest=1 << 20)
    for message in (BEGIN, SnapshotRows([thing("old")]), SnapshotEnd(1)):
        replica.take(message)
    return replica


@pytest.fixture
def replica(tmp_path: Path) -> Iterator[Replica]:
    replica = begun(tmp_path)
    yield replica
    replica.close()


def names(tmp_path: Path) -> list[str]:
    return [row[0] for row in tables_of(tmp_path / "state.db")["thing"]]


@pytest.mark.nightly
def test_changes_and_their_number_are_stored_together(tmp_path: Path) -> None:
    replica = begun(tmp_path)
    replica.take(changes(thing("a"), thing("b")))
    replica.take(changes(Delete("thing", [("name", "=", "old")]), epoch=4, first=10))
    replica.take(changes(first=11, epoch=4))
    replica.close()
    assert names(tmp_path) == ["a", "b"]
    again = Replica(tmp_path / "state.db", SCHEMA, failed=pytest.fail)
    assert again.position == replica.position == Stored(4, "h", 10)
    again.close()


def test_a_sync_brings_what_is_stored_to_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A commit does not wait for the disk, because an answer waits for it. `sync` then synchronizes SQLite's log."""
    synced: list[str] = []
    replica = begun(tmp_path)
    monkeypatch.setattr(
        os, "fsync", lambda file: synced.append(str(Path(f"/proc/self/fd/{file}").readlink()))
    )
    replica.take(changes(thing("a")))
    assert synced == []
    replica.sync()
    assert [Path(name).name for name in synced] == ["state.db-wal"]
    replica.close()


def test_after_a_failed_sync_it_stores_nothing_until_one_succeeds_and_then_needs_a_snapshot(
    replica: Replica, tmp_path: Path
) -> None:
    """Otherwise the active appliance would answer, and a power cut of both would lose more than the last 0.1 s."""

    def fails(_file: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    replica.take(changes(thing("a")))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", fails)
        with pytest.raises(StoreError, match="Input/output error"):
            replica.sync()
        for message in (changes(first=9), SnapshotBegin(3, "h", 9)):
            with pytest.raises(StoreError, match=r"state\.db cannot be written to the disk"):
                replica.take(message)
    replica.sync()
    assert (replica.unsynced, replica.position) == ("", Stored(3, "", 0))
    with pytest.raises(ReplicationError, match="another history"):
        replica.take(changes(thing("b"), first=9))
    for snapshot in (BEGIN, SnapshotRows([thing("b")]), SnapshotEnd(1)):
        replica.take(snapshot)
    assert names(tmp_path) == ["b"]


BAD: list[tuple[FromActive, str]] = [
    (changes(thing("a"), epoch=2), "epoch 2 has ended: epoch 3 has begun"),
    (changes(epoch=2), "epoch 2 has ended"),
    (SnapshotBegin(2, "h", 9), "epoch 2 has ended"),
    (changes(thing("a"), first=9), "change 9 does not follow change 7"),
    (changes(thing("a"), first=7), "change 7 does not follow change 7"),
    (changes(first=9), "change 9 does not follow"),
    (changes(thing("a"), history="i"), "another history need a snapshot"),
    (changes(thing("a"), Put("journal", [(1, 9, "h", 9)])), "no table 'journal'"),
    (changes(thing("a"), Put("sqlite_master", [("a",)])), "no table 'sqlite_master'"),
    (changes(thing("a"), Put("thing", [("b", 1)])), "a row of thing has 3 values, not 2"),
    (changes(thing("a"), Put("thing", [("b", "1", None)])), "thing.size cannot be of type str"),
    (changes(thing("a"), Delete("thing", [("colour", "=", 1)])), "thing has no column 'colour'"),
    (changes(thing("a"), Delete("thing", [])), "has 0 conditions"),
    (changes(thing("a"), Put("tree", [(2, b"", 1.0)])), "CHECK constraint failed"),
    (changes(thing("a"), Put("tree", [(1, b"", float("nan"))])), "tree.weight is not a number"),
    (SnapshotRows([thing("a")]), "SnapshotRows is out of order"),
    (SnapshotEnd(0), "SnapshotEnd is out of order"),
]


@pytest.mark.parametrize(("message", "reason"), BAD)
def test_an_active_appliance_that_lies_changes_nothing(
    replica: Replica, tmp_path: Path, message: FromActive, reason: str
) -> None:
    with pytest.raises(ReplicationError, match=reason):
        replica.take(message)
    assert (names(tmp_path), replica.position) == (["old"], Stored(3, "h", 7))
    replica.take(changes(thing("next")))
    assert (names(tmp_path), replica.position) == (["next", "old"], Stored(3, "h", 8))


@pytest.mark.parametrize(
    ("messages", "reason"),
    [
        ([SnapshotRows([thing("a")]), SnapshotEnd(2)], "the snapshot has 1 row, but should have 2"),
        ([SnapshotRows([thing("a")]), changes(thing("b"))], "Changes is out of order"),
        ([SnapshotRows([thing("a")]), BEGIN], "SnapshotBegin is out of order"),
        ([SnapshotRows([thing("a"), Put("thing", [("b",)])])], "a row of thing has 3 values"),
        ([SnapshotRows([Put("tree", [(2, b"", 1.0)])])], "CHECK constraint failed"),
    ],
)
def test_a_snapshot_replaces_everything_or_nothing(
    replica: Replica, tmp_path: Path, messages: list[FromActive], reason: str
) -> None:
    replica.take(SnapshotBegin(5, "i", 2))
    for message in messages[:-1]:
        replica.take(message)
    with pytest.raises(ReplicationError, match=reason):
        replica.take(messages[-1])
    assert (names(tmp_path), replica.position) == (["old"], Stored(3, "h", 7))


def test_a_snapshot_that_ends_early_is_undone(tmp_path: Path) -> None:
    replica = begun(tmp_path)
    for end in (replica.abandon_snapshot, replica.close):
        replica.take(SnapshotBegin(5, "i", 2))
        replica.take(SnapshotRows([thing("new")]))
        end()
        assert names(tmp_path) == ["old"]
    again = Replica(tmp_path / "state.db", SCHEMA, failed=pytest.fail)
    assert again.position == Stored(3, "h", 7)
    for message in (SnapshotBegin(5, "i", 2), SnapshotRows([thing("new")]), SnapshotEnd(1)):
        again.take(message)
    assert (names(tmp_path), again.position) == (["new"], Stored(5, "i", 2))
    again.close()


def large(number: int) -> Put:
    return Put("thing", [(f"{number} {row}", 1, "x" * 10_000) for row in range(10)])


def test_an_active_appliance_cannot_fill_the_disk(replica: Replica, tmp_path: Path) -> None:
    def fill() -> None:
        for number in range(100):
            replica.take(changes(large(number), first=replica.position.number + 1))

    def fill_snapshot() -> None:
        replica.take(SnapshotBegin(5, "i", 2))
        for number in range(1000):
            replica.take(SnapshotRows([large(number % 50)]))

    for work in (fill, fill_snapshot):
        with pytest.raises(StoreError, match=r"state\.db: database or disk is full"):
            work()
        assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 8 << 20
    assert "old" in names(tmp_path)
    replica.take(changes(Delete("thing", [("size", "=", 1)]), first=replica.position.number + 1))
    replica.take(changes(thing("a"), first=replica.position.number + 1))
    assert names(tmp_path) == ["a"]


def test_repeated_rows_of_a_snapshot_need_no_further_space(replica: Replica, tmp_path: Path) -> None:
    replica.take(SnapshotBegin(5, "i", 2))
    for number in range(300):
        replica.take(SnapshotRows([large(number % 5)]))
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 8 << 20


@pytest.mark.nightly
def test_a_full_disk_keeps_the_last_good_state(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", "1m") as place:
        replica = Replica(place / "state.db", SCHEMA, failed=pytest.fail)
        for message in (BEGIN, SnapshotRows([thing("old")]), SnapshotEnd(1)):
            replica.take(message)
        filler = place / "filler"
        with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
            while file.write(bytes(4096)):
                pass
        with pytest.raises(StoreError, match=r"state\.db: .*full; free space there"):
            for number in range(10):
                replica.take(changes(large(number), first=replica.position.number + 1))
        stored = replica.position.number
        filler.unlink()
        assert names(place)[-1] == "old"
        replica.take(changes(thing("later"), first=stored + 1))
        assert "later" in names(place)
        replica.close()


def test_an_appliance_that_was_active_needs_a_snapshot(tmp_path: Path) -> None:
    replica = Replica(tmp_path / "state.db", SCHEMA, failed=pytest.fail)
    for message in (BEGIN, SnapshotEnd(0)):
        replica.take(message)
    replica.close()
    ahead = WriteAhead(tmp_path / "state.ahead")
    ahead.append([Encoded(8, msgspec.msgpack.encode(thing("own")))])
    ahead.close()
    again = Replica(tmp_path / "state.db", SCHEMA, failed=pytest.fail)
    assert (again.position.epoch, again.position.number) == (3, 8)
    with pytest.raises(ReplicationError, match="another history"):
        again.take(changes(thing("a"), first=9))
    again.close()
    database = InlineDatabase(tmp_path / "state.db", SCHEMA, failed=pytest.fail)
    database.put("thing", "more", 1, None)
    database.close()
    last = Replica(tmp_path / "state.db", SCHEMA, failed=pytest.fail)
    assert last.position == Stored(3, database.history, 9)
    last.close()


def test_all_tables_of_the_state_can_be_copied(tmp_path: Path) -> None:
    store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    with contextlib.closing(sqlite3.connect(tmp_path / "state.db")) as reader:
        found = {name for (name,) in reader.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    assert found == {*store.database.tables, "journal"}
    store.close()
    replica = Replica(tmp_path / "state.db", WHOLE_SCHEMA, failed=pytest.fail)
    replica.take(BEGIN)
    rows: dict[str, tuple[Any, ...]] = {
        "setting": ("name", "value"),
        "parameters": (1, b"tree"),
        "token": ("id", "name", "admin", b"salt", b"hash", 1.0, 2.0, None),
    }
    replica.take(SnapshotRows([Put(table, [row]) for table, row in rows.items()]))
    replica.take(SnapshotEnd(3))
    replica.close()
    again = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    assert (again.settings(), again.tokens()[0].name) == ({"name": "value"}, "name")
    assert again.database.number == 7
    again.close()
