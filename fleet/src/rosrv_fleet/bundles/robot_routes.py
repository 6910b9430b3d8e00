"""Serve bundles to robots as immutable files, with selections and their events, and receive the robots' reports.

A robot gets targets, selections and events only of the group in which it is enrolled.
"""

import asyncio
import hashlib
import re
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Annotated

import msgspec
import structlog
from fastapi import APIRouter, Depends, HTTPException, Request, Response
from fastapi.responses import StreamingResponse
from psycopg import Error as DatabaseError

from appliance.formats.bundle_api import EVENTS, METADATA, REPORT, SELECTION, TARGETS, RobotReport
from rosrv_fleet.enrolment import Robot, RobotGroup
from rosrv_fleet.request_body import read_body
from rosrv_fleet.rollouts.service import BundleService, RolloutRefusedError

_log = structlog.get_logger()
_METADATA_NAME = re.compile(r"[1-9][0-9]{0,9}\.[a-z0-9.-]{1,130}\.json")
_TARGET_NAME = re.compile(r"[0-9a-f]{64}\.[1-9][0-9]{0,8}\.tar")
_FOREVER = {"Cache-Control": "public, max-age=31536000, immutable"}
_HEARTBEAT_SECONDS = 30.0
_LONGEST_REPORT = 16_384
_MAX_LISTENERS = 2  # event streams of one robot: the old one may still be open when it connects again

Identify = Callable[[Request], Robot | Awaitable[Robot]]
"""Returns the robot with the client's certificate, or raises `HTTPException`."""


class EventStreams:
    """The open event streams, at most `_MAX_LISTENERS` for each robot."""

    def __init__(self, service: BundleService) -> None:
        self._service = service
        self._open: Counter[str] = Counter()

    def open(self, robot: str, group: RobotGroup) -> AsyncIterator[bytes]:
        if self._open[robot] >= _MAX_LISTENERS:
            raise HTTPException(429, "this robot has too many event streams")
        return self._stream(robot, group)

    async def _stream(self, robot: str, group: RobotGroup) -> AsyncIterator[bytes]:
        listener = self._service.listen(robot, group)
        self._open[robot] += 1
        try:
            yield b": listening\n\n"
            while self._open[robot] <= _MAX_LISTENERS:  # several may have opened at the same time
                try:
                    async with asyncio.timeout(_HEARTBEAT_SECONDS):
                        await listener.changed.wait()
                except TimeoutError:
                    yield b": still there\n\n"
                    continue
                if self._service.stopping:
                    return
                listener.changed.clear()
                yield b"event: selection\ndata: {}\n\n"
        finally:
            self._service.unlisten(listener)
            self._open[robot] -= 1
            if not self._open[robot]:
                del self._open[robot]


class OwnGroups:
    """Compares the group that a robot claims with its enrolled group. Logs a wrong claim once."""

    def __init__(self) -> None:
        self._logged: set[str] = set()

    def of(self, robot: Robot, site: str, group: str) -> RobotGroup:
        """Return the robot's group. Raise `HTTPException` (403) if it claims another one."""
        claimed = f"{site[:80]}/{group[:80]}"
        if robot.group == claimed:
            self._logged.discard(robot.name)
            return RobotGroup.parse(robot.group)
        enrolled = f"in {robot.group}" if robot.group else "without a group"
        if robot.name not in self._logged:
            self._logged.add(robot.name)
            _log.warning("a robot claims another group", robot=robot.name, group=robot.group, claimed=claimed)
        raise HTTPException(
            403,
            f"{robot.name} is enrolled {enrolled}, not in {claimed}; correct fleet.bundles of its appliance.yaml, or on"
            f" the collector: rosrv-fleet robot group {robot.name} SITE/GROUP",
        )


def robot_routes(service: BundleService, identify: Identify) -> APIRouter:
    router = APIRouter(tags=["bundles"])
    caller = Annotated[Robot, Depends(identify)]
    groups = OwnGroups()

    @router.get(f"/{METADATA}/timestamp.json")
    async def timestamp(request: Request, _robot: caller) -> Response:
        """Return the newest timestamp."""
        if service.publisher.timestamp is None:
            raise HTTPException(404, service.publisher.trouble or "nothing is published")
        return _tag(request, service.publisher.timestamp, "application/json")

    @router.get(f"/{METADATA}/{{name}}")
    async def metadata(name: str, _robot: caller) -> Response:
        """Return a signed metadata file."""
        if _METADATA_NAME.fullmatch(name) is None:
            raise HTTPException(404, "there are no such metadata")
        return await _file(service.publisher.folder / "metadata" / name, "application/json")

    @router.get(f"/{TARGETS}/{{site}}/{{group}}/{{name}}")
    async def target(site: str, group: str, name: str, robot: caller) -> Response:
        """Return an archive of a bundle of the robot's group."""
        place = groups.of(robot, site, group)
        if _TARGET_NAME.fullmatch(name) is None:
            raise HTTPException(404, "this bundle does not exist")
        return await _file(
            service.publisher.folder / "targets" / place.site / place.group / name, "application/x-tar"
        )

    @router.get(f"/{SELECTION}/{{site}}/{{group}}")
    async def selection(request: Request, site: str, group: str, robot: caller) -> Response:
        """Return the bundle that the robot should have; empty for none."""
        own = groups.of(robot, site, group)
        return _tag(request, service.selection(robot.name, own).encode(), "text/plain")

    @router.put(f"/{REPORT}", status_code=204)
    async def keep_report(request: Request, robot: caller) -> None:
        """Store a robot's report about itself."""
        body = await read_body(request, _LONGEST_REPORT)
        try:
            report = msgspec.json.decode(body, type=RobotReport)
        except ValueError as error:
            raise HTTPException(422, str(error)) from error
        try:
            await service.report(robot.name, groups.of(robot, report.site, report.group), report)
        except RolloutRefusedError as error:
            raise HTTPException(422, str(error)) from error
        except DatabaseError as error:
            raise HTTPException(503, "the database is unreachable: report again later") from error

    streams = EventStreams(service)

    @router.get(f"/{EVENTS}/{{site}}/{{group}}")
    async def events(site: str, group: str, robot: caller) -> Response:
        """Send an event whenever the robot's selection changes."""
        stream = streams.open(robot.name, groups.of(robot, site, group))
        return StreamingResponse(
            stream, media_type="text/event-stream", headers={"Cache-Control": "no-store"}
        )

    return router


def _tag(request: Request, body: bytes, kind: str) -> Response:
    tag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
    headers = {"ETag": tag, "Cache-Control": "no-cache"}
    if request.headers.get("If-None-Match") == tag:
        return Response(status_code=304, headers=headers)
    return Response(body, media_type=kind, headers=headers)


async def _file(path: Path, kind: str) -> Response:
    try:
        return Response(await asyncio.to_thread(path.read_bytes), media_type=kind, headers=_FOREVER)
    except OSError as error:
        raise HTTPException(404, "this file does not exist") from error
