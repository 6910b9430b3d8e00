import gzip
import os
from datetime import date
from pathlib import Path

import pytest
from rosrv_fleet import retention
from rosrv_fleet.config import RetentionConfig
from rosrv_fleet.database import IndexDatabase
from rosrv_fleet.retention import Pruner
from rosrv_fleet.segment_store import SegmentPlace, SegmentStore

from tests.support.enrolled_robots import enrolled_robots

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

    monkeypatch.setattr(retention, "drop_partitions", drop)
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
