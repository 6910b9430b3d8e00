"""Serve bundles to robots: metadata and targets as immutable files, their selection, events, and their reports.

A robot is identified by its certificate. Metadata and targets are the same for all robots; selections, events and
reports are about the robot that asks.
"""

import asyncio
import hashlib
import re
from collections import Counter
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Annotated

import msgspec
from fastapi import APIRouter, Depends, HTTPException, Request, Response
from fastapi.responses import StreamingResponse
from psycopg import Error as DatabaseError
from starlette.requests import ClientDisconnect

from appliance.bundles.poller import REPORT, RobotReport
from appliance.bundles.process import EVENTS
from appliance.bundles.verified_bundles import METADATA, SELECTION, TARGETS
from rosrv_fleet.rollouts.service import BundleService, RolloutRefusedError
from rosrv_fleet.rollouts.store import Group

_METADATA_NAME = re.compile(r"[1-9][0-9]{0,9}\.[a-z0-9.-]{1,130}\.json")
_TARGET_NAME = re.compile(r"[0-9a-f]{64}\.[1-9][0-9]{0,8}\.tar")
_FOREVER = {"Cache-Control": "public, max-age=31536000, immutable"}
_HEARTBEAT_SECONDS = 30.0
_LONGEST_REPORT = 16_384
_REPORT_SECONDS = 30.0
_MOST_LISTENERS = 2  # event streams of one robot: the old one may still be open when it connects again

Identify = Callable[[Request], str]
"""Returns the name of the robot with the client's certificate; raises `HTTPException` for any other caller."""


class EventStreams:
    """The open event streams of robots, at most `_MOST_LISTENERS` for each."""

    def __init__(self, service: BundleService) -> None:
        self._service = service
        self._open: Counter[str] = Counter()

    def open(self, robot: str, group: Group) -> AsyncIterator[bytes]:
        """Return the stream of a robot's events. Raises `HTTPException` if it has too many."""
        if self._open[robot] >= _MOST_LISTENERS:
            raise HTTPException(429, "this robot has too many event streams")
        return self._stream(robot, group)

    async def _stream(self, robot: str, group: Group) -> AsyncIterator[bytes]:
        self._open[robot] += 1
        listener = self._service.listen(robot, group)
        try:
            yield b": listening\n\n"
            while self._open[robot] <= _MOST_LISTENERS:  # several may have opened at the same time
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


def robot_routes(service: BundleService, identify: Identify) -> APIRouter:
    """Return the routes for robots."""
    router = APIRouter(tags=["bundles"])
    robot_name = Annotated[str, Depends(identify)]

    def group_of(site: str, group: str) -> Group:
        try:
            return service.group(site, group)
        except RolloutRefusedError as error:
            raise HTTPException(422, str(error)) from error

    @router.get(f"/{METADATA}/timestamp.json")
    async def timestamp(request: Request, _robot: robot_name) -> Response:
        """Return the newest timestamp."""
        if service.timestamp is None:
            raise HTTPException(404, service.trouble or "nothing is published")
        return _tagged(request, service.timestamp, "application/json")

    @router.get(f"/{METADATA}/{{name}}")
    async def metadata(name: str, _robot: robot_name) -> Response:
        """Return a signed metadata file."""
        if _METADATA_NAME.fullmatch(name) is None:
            raise HTTPException(404, "there are no such metadata")
        return await _file(service.folder / "metadata" / name, "application/json")

    @router.get(f"/{TARGETS}/{{site}}/{{group}}/{{name}}")
    async def target(site: str, group: str, name: str, _robot: robot_name) -> Response:
        """Return a bundle's archive."""
        place = group_of(site, group)
        if _TARGET_NAME.fullmatch(name) is None:
            raise HTTPException(404, "this bundle does not exist")
        return await _file(service.folder / "targets" / place.site / place.group / name, "application/x-tar")

    @router.get(f"/{SELECTION}/{{site}}/{{group}}")
    async def selection(request: Request, site: str, group: str, robot: robot_name) -> Response:
        """Return the bundle that the robot should have; empty for none."""
        return _tagged(request, service.selection(robot, group_of(site, group)).encode(), "text/plain")

    @router.put(f"/{REPORT}", status_code=204)
    async def report(request: Request, robot: robot_name) -> None:
        """Store what the robot reports about itself."""
        try:
            async with asyncio.timeout(_REPORT_SECONDS):
                body = await _body(request)
            await service.report(robot, msgspec.json.decode(body, type=RobotReport))
        except ClientDisconnect as error:
            raise HTTPException(400, "the robot ended the connection") from error
        except TimeoutError as error:
            raise HTTPException(408, f"a report takes at most {_REPORT_SECONDS:g} s") from error
        except (msgspec.DecodeError, RolloutRefusedError) as error:
            raise HTTPException(422, str(error)) from error
        except DatabaseError as error:
            raise HTTPException(503, "the database is unreachable: report again later") from error

    streams = EventStreams(service)

    @router.get(f"/{EVENTS}/{{site}}/{{group}}")
    async def events(site: str, group: str, robot: robot_name) -> Response:
        """Send an event whenever the robot's selection changes."""
        stream = streams.open(robot, group_of(site, group))
        return StreamingResponse(
            stream, media_type="text/event-stream", headers={"Cache-Control": "no-store"}
        )

    return router


async def _body(request: Request) -> bytes:
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > _LONGEST_REPORT:
            raise HTTPException(413, f"a report has at most {_LONGEST_REPORT} bytes")
    return body


def _tagged(request: Request, body: bytes, kind: str) -> Response:
    """Return a body with its entity tag, or 304 if the client has it."""
    tag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
    headers = {"ETag": tag, "Cache-Control": "no-cache"}
    if request.headers.get("If-None-Match") == tag:
        return Response(status_code=304, headers=headers)
    return Response(body, media_type=kind, headers=headers)


async def _file(path: Path, kind: str) -> Response:
    """Return a file whose name determines its content."""
    try:
        return Response(await asyncio.to_thread(path.read_bytes), media_type=kind, headers=_FOREVER)
    except OSError as error:
        raise HTTPException(404, "this file does not exist") from error
