import gzip
import os
from datetime import date
from pathlib import Path

import pytest
from rosrv_fleet import collector
from rosrv_fleet.collector import Collector, Pruner
from rosrv_fleet.config import RetentionConfig
from rosrv_fleet.database import IndexDatabase
from rosrv_fleet.segment_store import SegmentPlace, SegmentStore

from appliance.base.clock import using, utc_now, wall
from fleet.tests.support.collectors import collector_in, upload
from fleet.tests.support.enrolled_robots import enrolled_robots
from tests.support.virtual_clock import VirtualClock, let_time_pass, set_wall

_DAY = 86_400
_DAMAGED = "0" * 32, "1" * 32


@pytest.mark.parametrize(
    "content",
    [b"", gzip.compress(b"")[:10] + b"\xff" * 64, gzip.compress(b"{}\n")],
    ids=["empty", "no deflate", "no header"],
)
def test_damaged_logs_do_not_stop_the_retention(
    content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dropped: list[date] = []

    def drop(_database: IndexDatabase, oldest: date) -> list[date]:
        dropped.append(oldest)
        return []

    monkeypatch.setattr(collector, "drop_partitions", drop)
    store, robots = SegmentStore(tmp_path, 0), enrolled_robots(tmp_path, "arm1")
    files = [store.path(SegmentPlace("arm1", log, number, "a" * 64)) for log in _DAMAGED for number in (1, 2)]
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
        os.utime(file, (1e9, 1e9))
    database = IndexDatabase("", connections=1, statement_seconds=1.0)
    pruner = Pruner(store, robots, database, RetentionConfig(index_days=1, segment_days=1))
    pruner.step()
    assert all(file.exists() for file in files)
    assert pruner.trouble is not None
    assert f"arm1: log {_DAMAGED[-1]}" in pruner.trouble
    assert len(dropped) == 1


def _started(folder: Path) -> Collector:
    """Return a collector that keeps segments for 30 days, as after its start."""
    if not (folder / "robots").exists():
        enrolled_robots(folder, "arm7")
    return collector_in(folder, retention=RetentionConfig(index_days=30, segment_days=30))


def _push(collector: Collector, number: int) -> None:
    collector.store.mark_indexed(upload(collector.store, number))


def _kept(collector: Collector) -> list[int]:
    """Return the numbers of the segments after a turn of the retention."""
    collector.pruner.step()
    assert collector.pruner.trouble is None
    (log,) = collector.store.logs("arm7")
    return [place.number for place in collector.store.segments("arm7", log)]


@pytest.fixture
def oldest_days(monkeypatch: pytest.MonkeyPatch) -> list[date]:
    days: list[date] = []

    def drop(_database: IndexDatabase, oldest: date) -> list[date]:
        days.append(oldest)
        return []

    monkeypatch.setattr(collector, "drop_partitions", drop)
    return days


@pytest.mark.parametrize("years", [3, -3], ids=["ahead", "behind"])
def test_a_wrong_clock_removes_nothing(years: int, tmp_path: Path, oldest_days: list[date]) -> None:
    """Segments that arrive in that time are removed neither earlier nor later than those after them."""
    collector, before = _started(tmp_path), utc_now().date()
    _push(collector, 1)
    let_time_pass(_DAY)
    _push(collector, 2)
    assert _kept(collector) == [1, 2]
    set_wall(wall() + years * 365 * _DAY)
    collector = _started(tmp_path)
    _push(collector, 3)
    _push(collector, 4)
    assert _kept(collector) == [1, 2, 3, 4]
    let_time_pass(_DAY / 2)
    set_wall(wall() - years * 365 * _DAY)
    _push(collector, 5)
    _push(collector, 6)
    assert _kept(collector) == [1, 2, 3, 4, 5, 6]
    assert {(before - day).days for day in oldest_days} <= {28, 29, 30}
    let_time_pass(28 * _DAY)
    assert _kept(collector) == [1, 2, 3, 4, 5, 6]
    let_time_pass(_DAY)
    assert _kept(collector) == [2, 3, 4, 5, 6]
    let_time_pass(2 * _DAY)
    assert _kept(collector) == [6]


def test_segments_that_arrive_after_a_long_time_off_stay_as_long_as_others(
    tmp_path: Path, oldest_days: list[date]
) -> None:
    """The time off counts after a day of running, but only for older segments."""
    collector = _started(tmp_path)
    _push(collector, 1)
    _push(collector, 2)
    assert _kept(collector) == [1, 2]
    let_time_pass(60 * _DAY)
    clock = VirtualClock(wall=wall())  # of the machine after its boot
    with using(clock):
        collector = _started(tmp_path)
        _push(collector, 3)
        _push(collector, 4)
        assert _kept(collector) == [1, 2, 3, 4]
        clock.advance(1.1 * _DAY)
        assert _kept(collector) == [3, 4]
        clock.advance(28 * _DAY)
        assert _kept(collector) == [3, 4]
        clock.advance(2 * _DAY)
        assert _kept(collector) == [4]
    assert len(oldest_days) == 5


def test_a_wrong_clock_at_the_first_start_of_this_version_removes_nothing(
    tmp_path: Path, oldest_days: list[date]
) -> None:
    collector = _started(tmp_path)
    _push(collector, 1)
    _push(collector, 2)
    (tmp_path / "age").unlink()
    set_wall(wall() + 3 * 365 * _DAY)
    assert _kept(_started(tmp_path)) == [1, 2]
    assert len(oldest_days) == 1
