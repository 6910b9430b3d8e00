import asyncio
import errno
import itertools
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NoReturn

import psycopg
import pytest
import structlog
from rosrv_fleet import cli, collector, indexer
from rosrv_fleet.collector import Pruner
from rosrv_fleet.config import FleetConfig, RetentionConfig
from rosrv_fleet.database import IndexDatabase
from rosrv_fleet.enrolment import RobotGroup
from rosrv_fleet.failures import failure_of
from rosrv_fleet.indexer import LANES, Indexer
from rosrv_fleet.output import configure_log
from rosrv_fleet.rollouts import service
from rosrv_fleet.rollouts.service import BundleService
from rosrv_fleet.rollouts.store import RolloutStore
from rosrv_fleet.segment_store import SegmentPlace, SegmentStore
from rosrv_fleet.workers import Workers

from fleet.tests.support.collectors import InlineWorkers
from fleet.tests.support.enrolled_robots import enrolled_robots

_DEFECT = "a defect of rosrv-fleet, please report it: RuntimeError: unforeseen"


def _defect(second: Callable[[], object] = bool) -> Callable[..., NoReturn]:
    """Return a function that fails at each call; at its second call, it calls `second` first."""
    calls = itertools.count(1)

    def defect(*_arguments: object, **_named: object) -> NoReturn:
        if next(calls) == 2:
            second()
        raise RuntimeError("unforeseen")

    return defect


def test_the_indexer_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work = Indexer(
        SegmentStore(tmp_path, 0),
        enrolled_robots(tmp_path, "arm1"),
        Workers(1),
        FleetConfig(certificate=tmp_path, key=tmp_path),
    )
    troubles: list[str | None] = []

    def stop() -> None:
        troubles.append(work.trouble)
        work.stop()

    monkeypatch.setattr(indexer, "_PAUSE_SECONDS", 0.0)
    monkeypatch.setattr(psycopg, "connect", _defect(stop))
    work.run("pending")
    assert troubles == [_DEFECT]


def test_a_segment_that_causes_a_defect_is_set_aside(tmp_path: Path) -> None:
    store = SegmentStore(tmp_path, 0)
    place = SegmentPlace("arm1", "0" * 32, 1, "a" * 64)
    (tmp_path / "pending" / "arm1").mkdir()
    (tmp_path / "pending" / "arm1" / place.mark).touch()
    work = Indexer(
        store,
        enrolled_robots(tmp_path, "arm1"),
        InlineWorkers(error=MemoryError()),
        FleetConfig(certificate=tmp_path, key=tmp_path),
    )
    assert [work.step(lane) for lane in LANES] == [True, False]
    assert (store.marks("pending", "arm1", 9), store.marks("damaged", "arm1", 9)) == ([], [place])
    assert work.trouble is not None
    assert "a defect of rosrv-fleet, please report it: MemoryError" in work.trouble


def test_retention_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    database = IndexDatabase("", connections=1, statement_seconds=1.0)
    work = Pruner(
        SegmentStore(tmp_path, 0), enrolled_robots(tmp_path, "arm1"), database, RetentionConfig(index_days=1)
    )
    monkeypatch.setattr(collector, "_AGAIN_SECONDS", 0.0)
    monkeypatch.setattr(collector, "drop_partitions", _defect(work.stop))
    work.run()
    assert work.trouble == f"retention: {_DEFECT}"


@pytest.mark.nightly
def test_rollouts_continue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service, "_PAUSE_SECONDS", 0.0)
    monkeypatch.setattr(service, "_TICK_SECONDS", 0.0)
    database = IndexDatabase("", connections=1, statement_seconds=1.0)

    async def run() -> None:
        loop, again = asyncio.get_running_loop(), asyncio.Event()
        defect = _defect(lambda: loop.call_soon_threadsafe(again.set))

        def members() -> Mapping[str, RobotGroup]:
            return defect()

        bundles = BundleService(tmp_path / "absent", tmp_path / "key", RolloutStore(database), members)
        running = asyncio.create_task(bundles.run())
        await asyncio.wait_for(again.wait(), 30)
        running.cancel()
        await asyncio.wait([running])

    asyncio.run(run())


def test_tracebacks_show_no_values(capfd: pytest.CaptureFixture[str]) -> None:
    """The value of a local variable may be a key."""
    earlier = structlog.get_config()
    try:
        configure_log()
        secret = "".join(chr(code) for code in range(ord("a"), ord("m")))
        with pytest.raises(RuntimeError) as caught:
            _defect()(secret)
        failure_of(caught.value)
    finally:
        structlog.configure(**earlier)
    shown = capfd.readouterr().err
    assert "raise RuntimeError" in shown
    assert secret not in shown


def test_a_command_on_a_full_disk_says_what_to_do() -> None:
    error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "data/tokens.json")
    assert cli.reason_of(error) == (
        "data/tokens.json: No space left on device; free space on this disk, and run the command again"
    )
