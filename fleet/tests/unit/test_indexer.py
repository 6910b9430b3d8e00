import errno
from pathlib import Path

import pytest
from rosrv_fleet.config import FleetConfig
from rosrv_fleet.indexer import Indexer
from rosrv_fleet.robots import Robots
from rosrv_fleet.segment_store import SegmentPlace, SegmentStore
from rosrv_fleet.workers import Workers

from fleet.tests.support.collectors import InlineWorkers
from fleet.tests.support.enrolled_robots import enrolled_robots

_PLACE = SegmentPlace("arm1", "0" * 32, 1, "a" * 64)


def _no_processes() -> None:
    raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")


@pytest.fixture
def store(tmp_path: Path) -> SegmentStore:
    store = SegmentStore(tmp_path, 0)
    (tmp_path / "pending" / "arm1").mkdir()
    (tmp_path / "pending" / "arm1" / _PLACE.mark).touch()
    return store


def _indexer(store: SegmentStore, data: Path, workers: Workers | None = None) -> Indexer:
    config = FleetConfig(certificate=data, key=data)
    return Indexer(store, Robots(data / "robots"), workers or InlineWorkers(before=_no_processes), config)


def test_segments_wait_while_no_worker_can_be_started(store: SegmentStore, tmp_path: Path) -> None:
    enrolled_robots(tmp_path, "arm1")
    with pytest.raises(BlockingIOError):
        _indexer(store, tmp_path).step("pending")
    assert store.marks("pending", "arm1", 9) == [_PLACE]
    assert store.marks("damaged", "arm1", 9) == []


def test_segments_wait_while_the_file_of_their_robot_is_damaged(store: SegmentStore, tmp_path: Path) -> None:
    enrolled_robots(tmp_path, "arm2")
    (tmp_path / "robots" / "arm1.json").write_bytes(b"damaged")
    indexer = _indexer(store, tmp_path)
    assert not indexer.step("pending")
    other = _PLACE._replace(robot="arm2")
    (tmp_path / "pending" / "arm2").mkdir()
    (tmp_path / "pending" / "arm2" / other.mark).touch()
    with pytest.raises(BlockingIOError):
        indexer.step("pending")
    assert store.marks("pending", "arm1", 9) == [_PLACE]
    assert store.marks("damaged", "arm1", 9) == []


def test_a_segment_that_was_replaced_is_indexed_again(store: SegmentStore, tmp_path: Path) -> None:
    enrolled_robots(tmp_path, "arm1")
    file = store.path(_PLACE)
    file.parent.mkdir(parents=True)
    file.write_bytes(b"damaged")
    whole = tmp_path / "whole"
    whole.write_bytes(b"whole")
    workers = InlineWorkers(
        before=lambda: whole.exists() and whole.rename(file), error=EOFError("the file ends too early")
    )
    indexer = _indexer(store, tmp_path, workers)
    assert indexer.step("pending")
    assert store.marks("pending", "arm1", 9) == [_PLACE]
    assert store.marks("damaged", "arm1", 9) == []
    assert indexer.step("pending")
    assert store.marks("pending", "arm1", 9) == []
    assert store.marks("damaged", "arm1", 9) == [_PLACE]


def test_a_segment_that_is_tried_again_stays_reported(store: SegmentStore, tmp_path: Path) -> None:
    indexer = _indexer(store, tmp_path)
    for lane in ("pending", "large"):
        assert indexer.step(lane)
        assert store.marks(lane, "arm1", 9) == []
        assert store.marks("damaged", "arm1", 9) == [_PLACE]
        store.try_again()
        assert store.marks("large", "arm1", 9) == store.marks("damaged", "arm1", 9) == [_PLACE]
        assert store.waiting(9) == 1
    store.mark_indexed(_PLACE)
    assert store.waiting(9) == 0
