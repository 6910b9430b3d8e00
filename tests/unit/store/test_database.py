"""One SQLite file with one writer thread."""

import asyncio
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.store.database import Database, StoreError

SCHEMA = "CREATE TABLE IF NOT EXISTS thing (name TEXT PRIMARY KEY, size INTEGER)"


@pytest.fixture
def failures() -> list[str]:
    """What the database complained about."""
    return []


@pytest.fixture
def database(tmp_path: Path, failures: list[str]) -> Iterator[Database]:
    """A new database."""
    database = Database(tmp_path / "state.db", SCHEMA, failed=failures.append)
    yield database
    database.close()


def test_what_was_queued_is_in_the_file_once_settled(database: Database, tmp_path: Path) -> None:
    """After `settled` another connection sees every statement, in order."""

    async def scene() -> None:
        for size in range(500):
            database.submit("INSERT OR REPLACE INTO thing VALUES ('a', ?)", (size,))
        await database.settled()

    asyncio.run(scene())
    with sqlite3.connect(tmp_path / "state.db") as other:
        assert other.execute("SELECT size FROM thing").fetchall() == [(499,)]


def test_closing_writes_what_is_left(tmp_path: Path) -> None:
    """Nothing that was queued before `close` is lost."""
    database = Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail)
    for number in range(3000):
        database.submit("INSERT INTO thing VALUES (?, 1)", (str(number),))
    database.close()
    again = Database(tmp_path / "state.db", SCHEMA, failed=pytest.fail)
    assert again.query("SELECT count(*) FROM thing") == [(3000,)]
    again.close()


def test_a_write_that_fails_is_tried_again_until_it_succeeds(
    database: Database, failures: list[str], tmp_path: Path
) -> None:
    """While another process holds the file, the failure is told; afterwards the row is there."""
    blocker = sqlite3.connect(tmp_path / "state.db", isolation_level=None)
    database.query("SELECT 1")
    blocker.execute("BEGIN EXCLUSIVE")

    async def scene() -> None:
        database.submit("INSERT INTO thing VALUES ('late', 1)")
        async with asyncio.timeout(60):
            while not failures:
                await asyncio.sleep(0.05)
            blocker.execute("COMMIT")
            await database.settled()

    asyncio.run(scene())
    blocker.close()
    assert "locked" in failures[0]
    assert database.query("SELECT name FROM thing") == [("late",)]


def test_a_file_that_is_no_database_is_named_with_what_to_do(tmp_path: Path) -> None:
    """Garbage in the place of the state is an error with the file's name, and stays untouched."""
    file = tmp_path / "state.db"
    file.write_bytes(b"this is not a database" * 100)
    with pytest.raises(StoreError, match=r"state\.db.*move the file away"):
        Database(file, SCHEMA, failed=pytest.fail)
    assert file.read_bytes().startswith(b"this is not")


def test_a_place_that_cannot_be_written_is_not_taken_for_a_bad_file(tmp_path: Path) -> None:
    """Where the place is at fault (a full disk, a folder that is not there), nobody is told to move the state away."""
    with pytest.raises(StoreError, match=r"state\.db.*make room") as caught:
        Database(tmp_path / "missing" / "state.db", SCHEMA, failed=pytest.fail)
    assert "move" not in str(caught.value)
