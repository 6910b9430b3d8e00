"""Accept segments from robots. An upload is bounded, verified, stored, and only then answered with a signed receipt."""

import asyncio
import gzip
import math
import time
import zlib
from collections.abc import AsyncIterator, Collection
from concurrent.futures.process import BrokenProcessPool
from contextlib import asynccontextmanager
from pathlib import Path
from typing import IO, Annotated, NamedTuple

import msgspec
import structlog
from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response
from fastapi import Path as PathParameter
from starlette.requests import ClientDisconnect

from appliance.base import clock
from appliance.formats.receipts import SegmentReceipt
from appliance.formats.segments import SegmentReader, SegmentSummary
from appliance.signing.log_proof import checkpoint_hash
from rosrv_fleet.access import certificate_of, robot_of
from rosrv_fleet.collector import LONG_CHECKS, SHORT_CHECKS, Collector
from rosrv_fleet.enrolment import Robot
from rosrv_fleet.quotas import OverQuotaError
from rosrv_fleet.segment_store import NotStorableError, SegmentPlace, StoreFullError, read_header
from rosrv_fleet.workers import OutOfTimeError, processor_time

# Verify an upload within a limit of processor time. Runs in a worker.

_MOST_PADDING = 64 << 10  # bytes that gzip may add; each later reader of the segment also pays for padding


class SegmentVerdict(NamedTuple):
    """The summary of a valid segment, or the reason why it is invalid. `late`: the time limit was too short.

    `size` is the number of uncompressed bytes that were read, `seconds` the processor time.
    """

    summary: SegmentSummary | None
    reason: str
    late: bool
    size: int
    seconds: float


def check_segment(upload: Path, keys: Collection[bytes], most_bytes: int, seconds: float) -> SegmentVerdict:
    """Verify a segment with raw public keys, in at most `seconds` of processor time. Raise `OSError`."""
    begun = time.process_time()
    summary, reason, late = None, "", False
    with gzip.open(upload) as file:
        try:
            with processor_time(seconds):
                reader = SegmentReader(file, keys, most_bytes)
                read_header(upload)
                summary = reader.summary()
        except OutOfTimeError as error:
            reason, late = str(error), True
        except (ValueError, EOFError, zlib.error, gzip.BadGzipFile) as error:
            reason = str(error)
        if summary is not None and upload.stat().st_size > file.tell() + _MOST_PADDING:
            summary, reason = None, "it is larger compressed than uncompressed"
        return SegmentVerdict(summary, reason, late, file.tell(), time.process_time() - begun)


_SHORT_SECONDS = 0.25
_NOT_THE_ROBOT = (400, 503)  # the connection ended, or the collector failed: no reason for a pause
_log = structlog.get_logger()
LogId = Annotated[str, PathParameter(pattern="^[0-9a-f]{32}$")]
SegmentNumber = Annotated[int, PathParameter(ge=1, lt=10**18)]
SegmentName = Annotated[str, PathParameter(pattern="^[0-9a-f]{64}$")]


def push_router(collector: Collector) -> APIRouter:
    router = APIRouter(prefix="/v1/logs/{log}")
    uploads = _Uploads(collector)
    RobotCaller = Annotated[Robot, Depends(robot_of(collector.robots))]  # noqa: N806  a type

    def heard(request: Request, robot: Robot, *, off: bool = False) -> None:
        appliance = robot.appliance_with(certificate_of(request) or b"")
        if appliance:
            collector.presence.heard(robot.name, appliance, off=off)

    @router.get("")
    def head(
        request: Request,
        log: LogId,
        robot: RobotCaller,
        upto: Annotated[int, Query(ge=0, lt=10**18)] = 10**18 - 1,
        *,
        idle: bool = False,
        off: bool = False,
    ) -> Response:
        """Return the newest stored checkpoint of the robot's log with a number up to `upto`; number 0: none.

        `hashes` has more than one hash if the robot signed several checkpoints with this number, and none if
        the disk has damaged the segment; then the robot sends it again. With `idle` the robot reports that it
        has nothing to push, and with `off` that it is being switched off.
        """
        if idle or off:
            heard(request, robot, off=off)
        found = collector.store.head(robot.name, log, upto)
        same = [] if found is None else collector.store.with_number(robot.name, log, found.number)
        hashes = [checkpoint_hash(header.end.text()) for header in collector.store.headers(same)]
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
        heard(request, robot)
        return Response(msgspec.json.encode(receipt), 201, media_type="application/json")

    return router


def _later(status: int, detail: str, seconds: float) -> HTTPException:
    return HTTPException(status, detail, {"Retry-After": str(max(1, math.ceil(seconds)))})


class _Cost(msgspec.Struct):
    """The cost of an upload: compressed and uncompressed bytes, and seconds of processor time."""

    received: int = 0
    unpacked: int = 0
    seconds: float = 0.0


class _Uploads:
    """The running uploads: at most one for each robot, and a limited number in total.

    The first check of a segment is short. A segment that takes longer waits for its turn with other large ones.
    """

    def __init__(self, collector: Collector) -> None:
        self._collector = collector
        self._limits = collector.config.limits
        self._busy: set[str] = set()
        self._short = asyncio.Semaphore(SHORT_CHECKS)
        self._long = asyncio.Semaphore(LONG_CHECKS)

    async def accept(self, request: Request, robot: Robot, place: SegmentPlace) -> SegmentReceipt:
        """Store the segment unless it is stored already, and return its receipt. Raise `HTTPException` or `OSError`."""
        async with self._turn(robot):
            if await asyncio.to_thread(self._collector.store.has, place):
                return await asyncio.to_thread(self._repeated, place)
            self._collector.store.check_space()
            if request.headers.get("content-encoding") != "gzip":
                raise HTTPException(415, "send the segment with Content-Encoding: gzip")
            quotas, cost = self._collector.quotas, _Cost()
            try:
                quotas.check(robot.name)
            except OverQuotaError as error:
                raise _later(429, str(error), error.seconds) from error
            file = self._collector.store.incoming()
            try:
                with file:
                    await self._receive(request, file, cost)
                return await self._keep(Path(file.name), robot, place, cost)
            except HTTPException as error:
                if error.status_code not in _NOT_THE_ROBOT:
                    quotas.refused(robot.name, cost.seconds)
                raise
            finally:
                await asyncio.to_thread(Path(file.name).unlink)
                await asyncio.to_thread(quotas.charge, robot.name, cost.received, cost.unpacked)

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

    async def _receive(self, request: Request, file: IO[bytes], cost: _Cost) -> None:
        try:
            async with asyncio.timeout(self._limits.upload_seconds):
                async for chunk in request.stream():
                    cost.received += len(chunk)
                    if cost.received > self._limits.upload_bytes:
                        raise HTTPException(
                            413, f"a compressed segment has at most {self._limits.upload_bytes} bytes"
                        )
                    self._collector.store.check_space(len(chunk))
                    file.write(chunk)
        except TimeoutError as error:
            raise HTTPException(408, f"an upload takes at most {self._limits.upload_seconds:g} s") from error
        except ClientDisconnect as error:
            raise HTTPException(400, "the robot closed the connection") from error

    def _repeated(self, place: SegmentPlace) -> SegmentReceipt:
        header = self._collector.store.header(place)
        self._collector.store.settle(place, header)
        return self._receipt(place, header.start[0] + 1, header.end.sequence)

    async def _keep(self, upload: Path, robot: Robot, place: SegmentPlace, cost: _Cost) -> SegmentReceipt:
        verdict = await self._check(upload, robot, cost)
        summary = verdict.summary
        if summary is None:
            _log.warning(
                "a segment was refused", robot=robot.name, number=place.number, reason=verdict.reason
            )
            raise HTTPException(422, f"not a valid segment of {robot.name}: {verdict.reason}")
        end = summary.header.end
        if (end.log, end.number, summary.name) != (place.log, place.number, place.name):
            raise HTTPException(422, f"its content is segment {end.number} {summary.name} of log {end.log}")
        try:
            await asyncio.to_thread(self._collector.store.keep, robot.name, upload, summary, verdict.size)
        except NotStorableError as error:
            _log.warning("a segment was refused", robot=robot.name, number=place.number, reason=str(error))
            raise HTTPException(409, str(error)) from error
        self._collector.indexer.wake()
        return self._receipt(place, summary.first, summary.last)

    async def _check(self, upload: Path, robot: Robot, cost: _Cost) -> SegmentVerdict:
        longest = self._limits.check_seconds
        verdict = await self._checked(self._short, upload, robot, min(_SHORT_SECONDS, longest), cost)
        if verdict.late and longest > _SHORT_SECONDS:
            verdict = await self._checked(self._long, upload, robot, longest, cost)
        return verdict

    async def _checked(
        self, turn: asyncio.Semaphore, upload: Path, robot: Robot, seconds: float, cost: _Cost
    ) -> SegmentVerdict:
        async with turn:
            work = self._collector.workers.submit(
                check_segment, upload, robot.public_keys, self._limits.segment_bytes, seconds
            )
            try:
                verdict = await asyncio.wrap_future(work)
            except BrokenProcessPool as error:
                raise _later(503, "the check of the segment ended early: send it again", 5) from error
        cost.unpacked += verdict.size
        cost.seconds += verdict.seconds
        return verdict

    def _receipt(self, place: SegmentPlace, first: int, last: int) -> SegmentReceipt:
        return SegmentReceipt(
            robot=place.robot, log=place.log, number=place.number, segment=place.name, first=first, last=last,
            time=clock.wall_ns(),
        ).sign(self._collector.receipt_key)  # fmt: skip
