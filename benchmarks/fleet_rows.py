"""Fill an index with the rows that a thousand robots write in twenty days, and define searches over them."""

import random
import re
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta

import psycopg
from rosrv_fleet.database import MIGRATIONS

_DAYS = 20
_SIMULATED = 1000
_BLOCK = 5000
_INDEX = re.compile(r"CREATE INDEX (record_\w+) ON record .*?;", re.DOTALL)


def fill(database: str, rows: int) -> None:
    indexes = {
        found[1]: found[0]
        for found in _INDEX.finditer((MIGRATIONS / "0001_segments_and_records.sql").read_text())
    }
    begun = time.monotonic()
    with psycopg.connect(database, autocommit=True) as connection:
        for name in indexes:
            connection.execute(f"DROP INDEX {name}".encode())
        today = datetime.now(UTC).date()
        for back in range(_DAYS):
            day = today - timedelta(back + 1)
            name = f"record_{day:%Y%m%d}"
            connection.execute(
                f"CREATE TABLE {name} PARTITION OF record FOR VALUES"
                f" FROM ('{day}') TO ('{day + timedelta(1)}')".encode()
            )
            with connection.cursor().copy(f"COPY {name} FROM STDIN".encode()) as copy:
                for block in _blocks(day.isoformat(), rows // _DAYS, back):
                    copy.write(block)
            noon = int(datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()) * 10**9
            connection.execute(
                "INSERT INTO segment VALUES ('sim', 'sim', %s, 'x', 1, 1, %s, %s, %s, %s)",
                (back, noon, noon + 86_399 * 10**9, noon, day),
            )
        print(f"{rows} rows by COPY: {time.monotonic() - begun:.0f} s", flush=True)
        for name, statement in indexes.items():
            at = time.monotonic()
            connection.execute(statement.encode())
            print(f"  {name}: {time.monotonic() - at:.0f} s", flush=True)
        connection.execute("VACUUM ANALYZE record")
        row = connection.execute("SELECT pg_size_pretty(pg_database_size(current_database()))").fetchone()
        print(f"index of {rows} rows: {row and row[0]}, {time.monotonic() - begun:.0f} s", flush=True)


def _blocks(day: str, rows: int, seed: int) -> Iterator[bytes]:
    chance = random.Random(seed)
    begin = int(datetime.fromisoformat(day).replace(tzinfo=UTC).timestamp() * 1e9)
    step = 86_400 * 10**9 // max(rows, 1)
    for start in range(0, rows, _BLOCK):
        yield "".join(
            _row(day, begin + number * step, seed * rows + number, chance)
            for number in range(start, min(rows, start + _BLOCK))
        ).encode()


def _row(day: str, moment: int, number: int, chance: random.Random) -> str:
    robot, host, topic = chance.randrange(_SIMULATED), chance.randrange(200), chance.randrange(300)
    denied = chance.random() < 0.02
    decision, severity = (
        ("deny", "warning" if chance.random() < 0.1 else "notice") if denied else ("allow", "info")
    )
    reason = f"no rule lets {host} publish" if denied else f"[Publishers] /cmd_{topic} lets it"
    detail = (
        f'{{"call":"registerPublisher","node":"/node{host}","type":"geometry_msgs/Twist","serial":{number}}}'
    )
    fields = (
        day, f"sim{robot:04}", "sim", number, f"{moment:020x}", moment, 1, "decision", severity, decision,
        f"10.0.{host // 250}.{host % 250}", f"/node{host}", "publish", f"/cmd_{topic}", "Publishers", "/cmd_*",
        "robot.ini", 12, 3, reason, 40, detail, "\\N",
    )  # fmt: skip
    return "\t".join(map(str, fields)) + "\n"


def searches() -> dict[str, Callable[[random.Random], dict[str, str]]]:
    return {
        "newest 100": lambda _chance: {},
        "denied, a day": lambda _chance: {"deny": "true", "since": "1d"},
        "denied, any time": lambda _chance: {"deny": "true"},
        "one host": lambda chance: {"host": f"10.0.0.{chance.randrange(200)}"},
        "one robot": lambda chance: {"robot": f"sim{chance.randrange(_SIMULATED):04}"},
        "a topic's glob, a week": lambda chance: {"topic": f"/cmd_{chance.randrange(30)}*", "since": "1w"},
        "a caller's glob": lambda chance: {"caller": f"/node{chance.randrange(20)}?"},
        "rare text": lambda chance: {"text": f'"serial":{chance.randrange(100_000, 400_000)}'},
        "frequent text": lambda _chance: {"text": "registerPublisher"},
        "text of no record": lambda chance: {"text": f"nothing like {chance.random()}"},
        "warnings": lambda _chance: {"severity": "warning"},
        "host and denied": lambda chance: {"host": f"10.0.0.{chance.randrange(200)}", "deny": "true"},
    }
