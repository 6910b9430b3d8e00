"""Compare the index of ClickHouse (`fleet/clickhouse/schema.sql`) with PostgreSQL's: answers, sizes and times.

    uv pip install --target build/clickhouse --no-deps --require-hashes -r benchmarks/fleet_clickhouse.lock
    PYTHONPATH=build/clickhouse python -m benchmarks.fleet_clickhouse                  # ten million rows

Both have the same rows and get the searches of the collector. A different answer ends the comparison with status 1.
"""

import argparse
import json
import random
import re
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import psycopg
from chdb.session import Session  # type: ignore[import-not-found]  # in an environment of its own, as the text says
from rosrv_fleet.database import migrate
from rosrv_fleet.search_sql import (
    FleetFilter,
    SearchCursor,
    SearchStatement,
    days_statement,
    search_statement,
)

from appliance.audit.filter_options import filter_given
from benchmarks.fleet_rows import fill, searches
from tests.system.fleet.postgres import postgres

SCHEMA = Path(__file__).parents[1] / "fleet/clickhouse/schema.sql"
_PAGE = 100
_REPEATED = (
    " LIMIT 1 BY robot, log, sequence"  # before the limit of the page: a segment that was inserted twice
)


class ClickHouseIndex:
    """The index in an embedded ClickHouse."""

    def __init__(self, folder: Path) -> None:
        self._session = Session(str(folder))
        self._session.query(SCHEMA.read_text())

    def insert(self, file: Path) -> None:
        """Insert the rows of a file in the text format of PostgreSQL's COPY."""
        self._session.query(f"INSERT INTO record SELECT * FROM file('{file}', 'TabSeparated')")

    def merge(self) -> int:
        """Merge the parts as ClickHouse does by and by; return their size on disk, in bytes."""
        self._session.query("OPTIMIZE TABLE record FINAL")
        query = "SELECT sum(bytes_on_disk) FROM system.parts WHERE table = 'record' AND active"
        return int(str(self._session.query(query)))

    def rows(self, statement: SearchStatement) -> list[list[Any]]:
        """Return the rows that a search of the collector finds."""
        text, values = clickhouse_statement(statement)
        found = self._session.query(text, "JSONCompactEachRow", params=values)
        return [json.loads(line) for line in str(found).splitlines()]


def clickhouse_statement(statement: SearchStatement) -> tuple[str, dict[str, Any]]:
    """Translate a search of the collector from PostgreSQL's SQL to ClickHouse's, with named parameters."""
    values = [str(list(map(str, value))) if isinstance(value, list) else value for value in statement.values]
    text: str = statement.text.replace("ANY(%s::date[])", "ANY(%s)")
    text = re.sub(r"(\w+) ~ %s", r"match(\1, %s)", text).replace("= ANY(%s)", "IN %s")
    head, tail = text.rsplit(" LIMIT %s", 1)
    text = f"{head}{_REPEATED} LIMIT %s{tail}"
    for number, value in enumerate(statement.values):
        text = text.replace("%s", f"{{p{number}:{_kind(value)}}}", 1)
    return text, {f"p{number}": value for number, value in enumerate(values)}


def _kind(value: object) -> str:
    if isinstance(value, list):
        return "Array(String)"
    return "Int64" if isinstance(value, int) else "String"


def main() -> None:
    """Fill both indexes, compare the answers, and print sizes and times."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=int, default=10_000_000)
    parser.add_argument("--rounds", type=int, default=20, help="searches of each kind")
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="rosrv-bench-"))
    folder.chmod(0o755)  # for PostgreSQL's user
    try:
        with postgres() as cluster, psycopg.connect(cluster.create("bench"), autocommit=True) as connection:
            migrate(connection)
            fill(connection.info.dsn, given.rows)
            index = ClickHouseIndex(folder / "clickhouse")
            _copy(connection, index, folder / "rows.tsv")
            different = _compare(connection, index, given.rounds)
    finally:
        shutil.rmtree(folder)
    sys.exit(1 if different else 0)


def _copy(connection: psycopg.Connection[Any], index: ClickHouseIndex, file: Path) -> None:
    """Copy all rows, those of the last day twice: a collector that was killed inserts segments again."""
    days = [day for (day,) in connection.execute("SELECT DISTINCT day FROM record ORDER BY day")]
    total, seconds = 0, 0.0
    for day in [*days, days[-1]]:
        with file.open("wb") as out, connection.cursor() as cursor:
            query = f"COPY (SELECT * FROM record WHERE day = '{day}') TO STDOUT"
            with cursor.copy(query.encode()) as rows:
                for block in rows:
                    out.write(block)
            total += cursor.rowcount
        begun = time.monotonic()
        index.insert(file)
        seconds += time.monotonic() - begun
    print(f"ClickHouse: {total} rows inserted, {total / seconds:.0f} a second", flush=True)


def _compare(connection: psycopg.Connection[Any], index: ClickHouseIndex, rounds: int) -> int:
    """Compare the answers before and after the parts were merged; return the number of different answers."""
    different = _round(connection, index, 2, print_times=False)
    row = connection.execute("SELECT count(*), pg_database_size(current_database()) FROM record").fetchone()
    assert row is not None
    print(f"bytes a row: PostgreSQL {row[1] / row[0]:.0f}, ClickHouse {index.merge() / row[0]:.0f}")
    different += _round(connection, index, rounds, print_times=True)
    print(f"{different} answers differ")
    return different


def _round(
    connection: psycopg.Connection[Any], index: ClickHouseIndex, rounds: int, *, print_times: bool
) -> int:
    different, chance = 0, random.Random(7)
    for kind, words in searches().items():
        times: dict[str, list[float]] = {"PostgreSQL": [], "ClickHouse": []}
        for _ in range(rounds):
            statement = _statement(connection, words(chance), None)
            expected = _timed(times["PostgreSQL"], partial(_execute, connection, statement))
            found = _timed(times["ClickHouse"], partial(index.rows, statement))
            different += _differs(kind, expected, found)
            if len(expected) == _PAGE:  # the next page, by the cursor
                last = SearchCursor(expected[-1][4], expected[-1][0], expected[-1][3])
                statement = _statement(connection, words(random.Random(1)), last)
                different += _differs(kind, _execute(connection, statement), index.rows(statement))
        if print_times:
            print(f"  {kind:24} " + ", ".join(f"{name} {_figures(found)}" for name, found in times.items()))
    return different


def _statement(
    connection: psycopg.Connection[Any], words: dict[str, str], cursor: SearchCursor | None
) -> SearchStatement:
    given: dict[str, Any] = {name: True if value == "true" else value for name, value in words.items()}
    robot = given.pop("robot", None)
    record = filter_given(**given)
    of_days = days_statement(record)
    days = None if of_days is None else [day for (day,) in connection.execute(*of_days)]
    return search_statement(FleetFilter(robot, record), cursor, _PAGE, days)


def _differs(kind: str, expected: Sequence[Sequence[Any]], found: Sequence[Sequence[Any]]) -> bool:
    if [list(row) for row in expected] == [list(row) for row in found]:
        return False
    print(f"{kind}: PostgreSQL finds {len(expected)} rows, ClickHouse {len(found)}, or others")
    return True


def _execute(connection: psycopg.Connection[Any], statement: SearchStatement) -> list[tuple[Any, ...]]:
    return connection.execute(*statement).fetchall()


def _timed(times: list[float], work: Callable[[], Any]) -> Any:
    begun = time.monotonic()
    found = work()
    times.append(time.monotonic() - begun)
    return found


def _figures(times: Sequence[float]) -> str:
    return f"{1e3 * statistics.median(times):.0f} ms, at most {1e3 * max(times):.0f}"


if __name__ == "__main__":
    main()
