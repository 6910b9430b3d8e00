"""Add, list and return evidence bundles over REST. An upload is bounded, verified, and only then stored."""

import asyncio
import hashlib
import shutil
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Annotated

import msgspec
import structlog
from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response
from fastapi import Path as PathParameter
from fastapi.responses import FileResponse
from starlette.requests import ClientDisconnect

from appliance.base import clock
from rosrv_fleet.access import holder_of, name_of
from rosrv_fleet.collector import Collector
from rosrv_fleet.enrolment import EnrolmentError, Robot
from rosrv_fleet.evidence.check import EvidenceError, check_evidence
from rosrv_fleet.evidence.store import BUNDLE, StoredEvidence
from rosrv_fleet.robots import record_act
from rosrv_fleet.segment_store import StoreFullError
from rosrv_fleet.tokens import FleetRole

_MAX_UPLOADS = 4
_log = structlog.get_logger()
EvidenceId = Annotated[str, PathParameter(pattern="^[0-9a-f]{64}$")]
RobotName = Annotated[str, Query(max_length=63)]


def evidence_router(collector: Collector) -> APIRouter:
    """Return the routes. Viewers may list bundles; their content is for operators, as on the appliance."""
    router = APIRouter(prefix="/v1/evidence")
    additions = _Additions(collector)
    viewer = [Depends(holder_of(collector.tokens, FleetRole.VIEWER))]
    Operator = Annotated[str, Depends(name_of(holder_of(collector.tokens, FleetRole.OPERATOR)))]  # noqa: N806  a type

    @router.get("", dependencies=viewer)
    def stored(robot: RobotName = "") -> Response:
        """Return the bundles of a robot or of all, latest first."""
        return Response(msgspec.json.encode(collector.evidence.all(robot)), media_type="application/json")

    @router.get("/{evidence}")
    def content(evidence: EvidenceId, operator: Operator) -> FileResponse:
        """Return a bundle (ZIP)."""
        found = collector.evidence.get(evidence)
        if found is None:
            raise HTTPException(404, f"no evidence bundle {evidence}; list them: rosrv-fleet evidence list")
        path, name = collector.evidence.path(evidence), f"{found.robot}-{evidence[:12]}.zip"
        with record_act(collector.config.data, "evidence get", found.robot, evidence, operator):
            return FileResponse(path, media_type="application/zip", filename=name)

    @router.post("")
    async def add(request: Request, operator: Operator, robot: RobotName) -> Response:
        """Verify and store a bundle (ZIP) of a robot; 200 instead of 201 if it was stored before."""
        try:
            found, is_new = await additions.add(request, collector.robots.require(robot), operator)
        except EnrolmentError as error:
            raise HTTPException(404, str(error)) from error
        except EvidenceError as error:
            _log.warning("an evidence bundle was refused", robot=robot, reason=str(error))
            raise HTTPException(422, f"not valid evidence of {robot}: {error}") from error
        except StoreFullError as error:
            reason = "the disk is too full: evidence needs twice limits.reserve_bytes"
            raise _later(f"{reason}; {error.strerror}", 60) from error
        except OSError as error:
            _log.error("an evidence bundle was not stored", robot=robot, reason=str(error))
            raise _later("the collector cannot store evidence; see its log", 60) from error
        return Response(msgspec.json.encode(found), 201 if is_new else 200, media_type="application/json")

    return router


class _Additions:
    """The running additions: a few uploads at the same time, but one verification."""

    def __init__(self, collector: Collector) -> None:
        self._collector = collector
        self._limits = collector.config.evidence
        self._uploads = asyncio.Semaphore(_MAX_UPLOADS)
        self._turn = asyncio.Lock()

    async def add(self, request: Request, robot: Robot, who: str) -> tuple[StoredEvidence, bool]:
        """Return the stored bundle, and whether it is new. Raise `HTTPException` or `OSError`."""
        if self._uploads.locked():
            raise _later(f"{_MAX_UPLOADS} evidence bundles are being added", 60)
        async with self._uploads:
            upload = self._collector.evidence.incoming()
            try:
                await self._receive(request, upload / BUNDLE)
                async with self._turn:
                    return await self._keep(upload, robot, who)
            finally:
                # If it was kept, it is not there any more.
                await asyncio.to_thread(shutil.rmtree, upload, ignore_errors=True)

    async def _receive(self, request: Request, bundle: Path) -> None:
        """Write the upload to a file. Evidence leaves twice the reserve free, so that it cannot keep out segments."""
        most, seconds = self._limits.bundle_bytes, self._limits.upload_seconds
        reserve = self._collector.config.limits.reserve_bytes
        try:
            with bundle.open("xb") as file:
                async with asyncio.timeout(seconds):
                    async for chunk in request.stream():
                        if file.tell() + len(chunk) > most:
                            reason = f"an evidence bundle has at most {most} bytes (evidence.bundle_bytes)"
                            raise HTTPException(413, reason)
                        self._collector.store.check_space(len(chunk) + reserve)
                        file.write(chunk)
        except TimeoutError as error:
            reason = f"an upload takes at most {seconds:g} s (evidence.upload_seconds)"
            raise HTTPException(408, reason) from error
        except ClientDisconnect as error:
            raise HTTPException(400, "the client closed the connection") from error

    async def _keep(self, upload: Path, robot: Robot, who: str) -> tuple[StoredEvidence, bool]:
        digest = await asyncio.to_thread(_sha256, upload / BUNDLE)
        known = self._collector.evidence.get(digest)
        if known is not None and known.robot == robot.name:
            return known, False
        if known is not None:
            raise HTTPException(409, f"this bundle is stored already, as evidence of {known.robot}")
        size, most = (upload / BUNDLE).stat().st_size, self._limits.robot_bytes
        used = sum(one.bytes for one in self._collector.evidence.all(robot.name))
        if used + size > most:
            reason = f"{robot.name} may have {most} bytes of evidence: it has {used}, and this bundle {size}"
            raise HTTPException(413, f"{reason}; raise evidence.robot_bytes, or run evidence remove ID")
        collector = self._collector
        try:
            work = collector.workers.submit(check_evidence, collector.config, upload / BUNDLE, robot)
            content = await asyncio.wrap_future(work)
        except BrokenProcessPool as error:
            raise _later("the verification ended early: add the bundle again", 5) from error
        about = StoredEvidence(
            id=digest, robot=robot.name, bytes=size, added=clock.wall_ns(), by=who, **msgspec.structs.asdict(content)
        )  # fmt: skip
        await asyncio.to_thread(collector.evidence.keep, upload, about)
        return about, True


def _later(detail: str, seconds: int) -> HTTPException:
    return HTTPException(503, detail, {"Retry-After": str(seconds)})


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
