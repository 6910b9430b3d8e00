"""The parts of a real collector, without its server, its database and its worker processes."""

import gzip
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from rosrv_fleet.collector import Collector, make_collector
from rosrv_fleet.config import FleetConfig
from rosrv_fleet.receipt_key import make_receipt_key
from rosrv_fleet.segment_store import SegmentPlace, SegmentStore
from rosrv_fleet.workers import Workers

from appliance.audit.proof.copies import SignedCheckpoint
from appliance.formats.segments import SegmentHeader, SegmentSummary


def collector_in(data: Path, **config: Any) -> Collector:
    """Return the collector with this folder, as after its start."""
    make_receipt_key(data)
    collector = make_collector(FleetConfig(data=data, certificate=data, key=data, **config))
    collector.robots.known()
    return collector


class InlineWorkers(Workers):
    """They work in the caller's thread, after `before`, which may raise; with an `error`, all work fails with it."""

    def __init__(
        self, _count: int = 1, *, before: Callable[[], object] = bool, error: Exception | None = None
    ) -> None:
        super().__init__(1)
        self._before, self._error = before, error

    def submit(self, work: Callable[..., Any], *arguments: Any, **named: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self._before()
        try:
            if self._error is not None:
                raise self._error
            future.set_result(work(*arguments, **named))
        except Exception as error:  # noqa: BLE001  the caller gets it, as from a worker
            future.set_exception(error)
        return future


def upload(store: SegmentStore, number: int, robot: str = "arm7") -> SegmentPlace:
    """Keep a segment without records, as a robot sends it."""
    end = SignedCheckpoint("0" * 32, number, number, "a" * 64, 0, "b" * 64, "", "")
    header = SegmentHeader(begin=None, end=end)
    with store.incoming() as file:
        file.write(gzip.compress(header.line()))
    return store.keep(robot, Path(file.name), SegmentSummary(f"{number:064}", header, 0, 0), 1)
