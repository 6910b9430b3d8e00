from pathlib import Path

import psycopg
import pytest
from rosrv_fleet.database import MIGRATIONS, IndexDatabase, migrate


def test_migrations_run_once_and_in_order(database: str) -> None:
    with psycopg.connect(database) as connection:
        assert migrate(connection) == sorted(file.stem for file in MIGRATIONS.glob("*.sql"))
        assert migrate(connection) == []


def test_a_failed_migration_changes_nothing(database: str, tmp_path: Path) -> None:
    (tmp_path / "0001_a.sql").write_text("CREATE TABLE a (x int)")
    (tmp_path / "0002_b.sql").write_text("CREATE TABLE a (x int)")
    with psycopg.connect(database) as connection:
        with pytest.raises(psycopg.errors.DuplicateTable):
            migrate(connection, tmp_path)
        assert connection.execute("SELECT to_regclass('a')").fetchone() == (None,)


def test_a_reading_transaction_is_limited_and_cannot_write(database: str) -> None:
    for seconds, statement, error in (
        (0.2, "SELECT pg_sleep(60)", psycopg.errors.QueryCanceled),
        (30.0, "CREATE TABLE t (x int)", psycopg.errors.ReadOnlySqlTransaction),
    ):
        index = IndexDatabase(database, connections=1, statement_seconds=seconds)
        index.open()
        try:
            with pytest.raises(error), index.reading() as connection:
                connection.execute(statement)
        finally:
            index.close()
