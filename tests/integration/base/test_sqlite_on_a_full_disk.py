import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from appliance.base.full_disk import reason_of
from tests.support.small_disk import filled, small_disk


def test_a_database_that_cannot_be_opened_on_a_full_disk_says_so(tmp_path: Path) -> None:
    """SQLite needs room for its shared memory even to read, and reports an I/O error without it."""
    with small_disk(tmp_path / "state", "1m") as state:
        with closing(sqlite3.connect(state / "a.db")) as database:
            database.execute("PRAGMA journal_mode=WAL")
            database.execute("CREATE TABLE t (a)")
        with (
            filled(state),
            pytest.raises(sqlite3.OperationalError) as found,
            closing(sqlite3.connect(state / "a.db")) as database,
        ):
            database.execute("SELECT * FROM t").fetchall()
        with filled(state):
            assert reason_of(found.value, state).endswith(f": the disk of {state} is full")
