"""Accept segments from robots: bounded, verified, stored, and only then answered with a signed receipt."""

import asyncio
import gzip
import time
import zlib
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import IO, Annotated

import msgspec
import structlog
from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response
from fastapi import Path as PathParameter
from starlette.requests import ClientDisconnect

from appliance.audit.segments import SegmentError, SegmentReader
from appliance.signing.receipts import SegmentReceipt
from appliance.signing.signed_statements import checkpoint_hash
from rosrv_fleet.access import robot_of
from rosrv_fleet.collector import Collector
from rosrv_fleet.robots import Robot
from rosrv_fleet.segment_store import SegmentPlace, StoreFullError

_DAY_SECONDS = 86_400.0
_log = structlog.get_logger()
LogId = Annotated[str, PathParameter(pattern="^[0-9a-f]{32}$")]
SegmentNumber = Annotated[int, PathParameter(ge=1, lt=10**18)]
SegmentName = Annotated[str, PathParameter(pattern="^[0-9a-f]{64}$")]


def push_router(collector: Collector) -> APIRouter:
    """Return the routes of robots."""
    router = APIRouter(prefix="/v1/logs/{log}")
    uploads = _Uploads(collector)
    RobotCaller = Annotated[Robot, Depends(robot_of(collector.robots))]  # noqa: N806  a type

    @router.get("")
    def head(
        log: LogId, robot: RobotCaller, upto: Annotated[int, Query(ge=0, lt=10**18)] = 10**18 - 1
    ) -> Response:
        """Return the newest stored checkpoint of the robot's log with a number up to `upto`; number 0: none.

        `hashes` has more than one hash if the robot signed several checkpoints with this number.
        """
        found = collector.store.head(robot.name, log, upto)
        same = [] if found is None else collector.store.numbered(robot.name, log, found.number)
        hashes = [checkpoint_hash(collector.store.header(one).end.text()) for one in same]
        fields = {"robot": robot.name, "log": log, "number": found.number if found else 0, "hashes": hashes}
        return Response(msgspec.json.encode(fields), media_type="application/json")

    @router.put("/segments/{number}/{name}")
    async def put(
        request: Request, log: LogId, number: SegmentNumber, name: SegmentName, robot: RobotCaller
    ) -> Response:
        """Store a segment (gzip) and return its receipt. Repeating it is harmless."""
        place = SegmentPlace(robot.name, log, number, name)
        try:
            receipt = await uploads.accept(request, robot, place)
        except StoreFullError as error:
            raise _later(503, f"the collector's disk is full: {error.strerror}", 60) from error
        except OSError as error:
            _log.error("a segment was not stored", robot=robot.name, number=number, reason=str(error))
            raise _later(503, "the collector cannot store segments; see its log", 60) from error
        return Response(msgspec.json.encode(receipt), 201, media_type="application/json")

    return router


def _later(status: int, detail: str, seconds: float) -> HTTPException:
    return HTTPException(status, detail, {"Retry-After": str(max(1, round(seconds)))})


class _Uploads:
    """The uploads at work: one for each robot, a limited number together, and a day's bytes for each robot."""

    def __init__(self, collector: Collector) -> None:
        self._collector = collector
        self._limits = collector.config.limits
        self._busy: set[str] = set()
        self._stored: dict[str, deque[tuple[float, int]]] = {}

    async def accept(self, request: Request, robot: Robot, place: SegmentPlace) -> SegmentReceipt:
        """Return the receipt of a segment that is stored, now or before. Raises `HTTPException` and `OSError`."""
        async with self._turn(robot):
            if await asyncio.to_thread(self._collector.store.has, place):
                return await asyncio.to_thread(self._repeated, place)
            self._collector.store.check_space()
            if request.headers.get("content-encoding") != "gzip":
                raise HTTPException(415, "send the segment with Content-Encoding: gzip")
            self._check_quota(robot)
            file = self._collector.store.incoming()
            try:
                with file:
                    size = await self._receive(request, file)
                receipt = await asyncio.to_thread(self._keep, Path(file.name), robot, place)
            finally:
                await asyncio.to_thread(Path(file.name).unlink)
            self._stored.setdefault(robot.name, deque()).append((time.monotonic(), size))
            return receipt

    @asynccontextmanager
    async def _turn(self, robot: Robot) -> AsyncIterator[None]:
        if robot.name in self._busy:
            raise _later(429, "another upload of this robot is not finished", 2)
        if len(self._busy) >= self._limits.uploads:
            raise _later(503, f"{self._limits.uploads} robots are uploading", 2)
        self._busy.add(robot.name)
        try:
            yield
        finally:
            self._busy.discard(robot.name)

    def _check_quota(self, robot: Robot) -> None:
        stored = self._stored.get(robot.name, deque())
        while stored and time.monotonic() - stored[0][0] > _DAY_SECONDS:
            stored.popleft()
        if sum(size for _time, size in stored) >= self._limits.robot_bytes_per_day:
            raise _later(
                429, "this robot stored its limit of bytes for a day (limits.robot_bytes_per_day)", 3600
            )

    async def _receive(self, request: Request, file: IO[bytes]) -> int:
        """Copy the body to a file within the limits; return its size."""
        size = 0
        try:
            async with asyncio.timeout(self._limits.upload_seconds):
                async for chunk in request.stream():
                    size += len(chunk)
                    if size > self._limits.upload_bytes:
                        raise HTTPException(
                            413, f"a compressed segment has at most {self._limits.upload_bytes} bytes"
                        )
                    self._collector.store.check_space(len(chunk))
                    file.write(chunk)
        except TimeoutError as error:
            raise HTTPException(408, f"an upload takes at most {self._limits.upload_seconds:g} s") from error
        except ClientDisconnect as error:
            raise HTTPException(400, "the robot closed the connection") from error
        return size

    def _repeated(self, place: SegmentPlace) -> SegmentReceipt:
        header = self._collector.store.header(place)
        self._collector.store.settle(place, header)
        return self._receipt(place, header.start[0] + 1, header.end.sequence)

    def _keep(self, upload: Path, robot: Robot, place: SegmentPlace) -> SegmentReceipt:
        try:
            with gzip.open(upload) as file:
                summary = SegmentReader(file, robot.public_key, self._limits.segment_bytes).summary()
        except (SegmentError, EOFError, zlib.error, gzip.BadGzipFile) as error:
            _log.warning("a segment was refused", robot=robot.name, number=place.number, reason=str(error))
            raise HTTPException(422, f"not a valid segment of {robot.name}: {error}") from error
        end = summary.header.end
        if (end.log, end.number, summary.name) != (place.log, place.number, place.name):
            raise HTTPException(422, f"its content is segment {end.number} {summary.name} of log {end.log}")
        self._collector.store.keep(robot.name, upload, summary)
        self._collector.indexer.wake()
        return self._receipt(place, summary.first, summary.last)

    def _receipt(self, place: SegmentPlace, first: int, last: int) -> SegmentReceipt:
        return SegmentReceipt(
            robot=place.robot, log=place.log, number=place.number, segment=place.name, first=first, last=last,
            time=time.time_ns(),
        ).signed(self._collector.receipt_key)  # fmt: skip
