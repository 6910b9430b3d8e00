"""The ends in the state of version 0.3.0, which stored them in seven places."""

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from appliance.base import clock
from appliance.store.ends import EndKind
from appliance.store.state_file import StateStore
from tests.support.ends import ends_of
from tests.support.engines import InlineDatabase
from tests.support.sources import ROOT
from tests.support.virtual_clock import VirtualClock

WALL = 1_795_900_000.0
HOUR = 3600.0
SETTINGS = {
    "confirm": f"1 {WALL + HOUR} 7200.0",
    "confirm monitors": f"1 {WALL + 9 * HOUR} {HOUR}",  # the clock was set back
    "monitor returns": json.dumps(
        {"diary": {"until": WALL + HOUR, "seconds": 9 * HOUR, "back": True, "of": False}}
    ),
    "handled alarms": json.dumps(
        {
            "rosmaster": {"kind": "rosmaster", "who": "ann", "since": WALL, "until": WALL + HOUR, "note": ""},
            "clock": {"kind": "clock", "who": "ann", "since": WALL, "until": None, "note": ""},
        }
    ),
}
LEFT = {
    "token 9352c25226fe": 600.0,  # what was stored as left, and not the date
    "token 26d2d688a713": HOUR,
    "door ticket 0a1b2c3d4e5f": HOUR,
    "enrolment robot3": HOUR,
    "block 10.9.9.9": HOUR,
    "confirm 1": HOUR,
    "confirm monitors 1": HOUR,
    "timed switch diary": HOUR,
    "silence rosmaster": HOUR,
}


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Path]:
    with closing(sqlite3.connect(tmp_path / "state.db")) as database, database:
        database.executescript((ROOT / "tests/integration/state-0.3.0.sql").read_text())
        for table in ("token", "door_ticket", "enrolment_token"):
            database.execute(f"UPDATE {table} SET expires = ?", (WALL + HOUR,))  # noqa: S608  fixed names
        database.execute("UPDATE token_left SET seconds = 600.0")
        database.execute("UPDATE host_block SET ends = ?", (int((WALL + HOUR) * 1e9),))
        database.executemany("INSERT OR REPLACE INTO setting VALUES (?, ?)", SETTINGS.items())
    with clock.using(VirtualClock(wall=WALL, now=100.0)):
        yield tmp_path


def lefts(home: Path, **role: object) -> dict[str, float]:
    store = StateStore(home, failed=pytest.fail, kind=InlineDatabase)
    ends = ends_of(store, home, **role)
    found = {f"{row.kind} {row.name}": ends.left(EndKind(row.kind), row.name) for row in store.ends()}
    store.close()
    return {name: seconds for name, seconds in found.items() if seconds is not None}


def test_the_ends_of_version_0_3_0_are_taken_over_once(home: Path) -> None:
    assert lefts(home) == {name: pytest.approx(left, abs=1e-3) for name, left in LEFT.items()}
    with closing(sqlite3.connect(home / "state.db")) as database, database:
        assert database.execute("SELECT count(*) FROM token_left").fetchone() == (0,)
        database.execute("DELETE FROM ends WHERE kind = 'block'")
    assert lefts(home).keys() == LEFT.keys() - {"block 10.9.9.9"}


def test_a_takeover_from_version_0_3_0_reads_its_ends_by_its_clocks(home: Path) -> None:
    reading = {"appliance": "a", "wall": WALL, "age": int(WALL * 1e9)}
    with closing(sqlite3.connect(home / "state.db")) as database, database:
        database.execute("INSERT INTO setting VALUES ('reading of the clocks', ?)", (json.dumps(reading),))
    with clock.using(VirtualClock(wall=WALL + 9e7, now=100.0)):
        left = lefts(home, appliance="b", away_seconds=5.0)
    assert left == {name: pytest.approx(seconds - 5.0 + 0.0, abs=1e-3) for name, seconds in LEFT.items()}
