"""Make the REST application of the collector from one router for each part of the API."""

import asyncio
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from contextlib import asynccontextmanager
from typing import get_args

import msgspec
import structlog
from fastapi import APIRouter, Depends, FastAPI, HTTPException, Request, Response
from fastapi.responses import JSONResponse
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector as MetricSource
from starlette.concurrency import run_in_threadpool

from appliance.base import clock
from appliance.formats.fleet_membership import JOIN_PATH, JoinRequest
from rosrv_fleet.access import holder_of, name_of, robot_of
from rosrv_fleet.bundles.robot_routes import robot_routes
from rosrv_fleet.collector import Collector
from rosrv_fleet.connections import owner_of
from rosrv_fleet.console.routes import console_router
from rosrv_fleet.enrolment import EnrolmentError, Robot, require_own_signature
from rosrv_fleet.evidence.routes import evidence_router
from rosrv_fleet.health import FleetHealth, health_of
from rosrv_fleet.indexer import LANES
from rosrv_fleet.invitations import InvalidInvitationError, Invitations
from rosrv_fleet.push_routes import push_router
from rosrv_fleet.request_body import read_body
from rosrv_fleet.rollouts.machine import RolloutState
from rosrv_fleet.rollouts.operator_routes import group_state, operator_routes
from rosrv_fleet.rollouts.service import BundleService
from rosrv_fleet.search_routes import search_router
from rosrv_fleet.segment_store import DamagedFileError
from rosrv_fleet.tokens import FleetRole

# Enrol robots that send an invitation's token, the key of their log and their certificate.
#
# The certificate is self-signed, which proves that the sender has its private key. Every wrong token gets the same
# answer, and an address (in IPv6 its /64 network) that sends many of them has to wait.

_LONGEST = 16_384
_WRONG_PER_MINUTE = 30
_MAX_WRONG = 10_000


def join_router(collector: Collector) -> APIRouter:
    router = APIRouter()
    invitations = Invitations(collector.config.data / "invitations")
    wrong = WrongTokens()

    @router.post(JOIN_PATH)
    async def join(request: Request) -> Response:
        """Enrol the robot that the token names. No certificate or other token is needed."""
        address = request.client.host if request.client else "127.0.0.1"
        wrong.require_patience(address)
        body = await read_body(request, _LONGEST)
        try:
            given = msgspec.json.decode(body, type=JoinRequest)
        except ValueError as error:
            raise HTTPException(422, f"not a request to join: {error}") from error
        try:
            robot = await run_in_threadpool(_enrol, collector, invitations, given)
        except InvalidInvitationError as error:
            wrong.add(address)
            _log.warning("an invitation was refused", address=address)
            raise HTTPException(403, str(error)) from error
        except EnrolmentError as error:
            raise HTTPException(409, str(error)) from error
        except OSError as error:
            _log.error("a robot was not enrolled", address=address, reason=str(error))
            raise HTTPException(503, "the collector cannot enrol robots now; see its log") from error
        _log.warning("a robot joined", robot=robot.name, address=address, certificate=robot.fingerprint)
        return Response(msgspec.json.encode({"robot": robot.name}), 201, media_type="application/json")

    return router


def _enrol(collector: Collector, invitations: Invitations, given: JoinRequest) -> Robot:
    certificate = given.certificate.encode()
    with invitations.using(given.token, msgspec.json.encode(given)) as pending:
        require_own_signature(certificate)
        return collector.robots.join(
            pending.name,
            given.key.encode(),
            certificate,
            pending.group,
            pending.appliance,
            again=bool(pending.request),
        )


class WrongTokens:
    """The wrong tokens of the last minute, by address or /64 network."""

    def __init__(self) -> None:
        self._sent: deque[tuple[float, str]] = deque(maxlen=_MAX_WRONG)

    def require_patience(self, address: str) -> None:
        """Raise `HTTPException` (429) if this address must wait."""
        while self._sent and clock.now() - self._sent[0][0] > 60.0:
            self._sent.popleft()
        owner = owner_of(address)
        if sum(sender == owner for _time, sender in self._sent) >= _WRONG_PER_MINUTE:
            raise HTTPException(429, "too many wrong invitations were sent", {"Retry-After": "60"})

    def add(self, address: str) -> None:
        self._sent.append((clock.now(), owner_of(address)))


# Health over REST, and metrics in Prometheus's format.


def health_router(collector: Collector) -> APIRouter:
    router = APIRouter()
    viewer = [Depends(holder_of(collector.tokens, FleetRole.VIEWER))]

    @router.get("/healthz")
    async def alive() -> dict[str, bool]:
        """Answer 200 while the collector runs; load balancers need no token."""
        return {"ok": True}

    @router.get("/v1/health", dependencies=viewer)
    def health() -> Response:
        """Return the state of the robots, the store and the index."""
        return Response(msgspec.json.encode(health_of(collector)), media_type="application/json")

    @router.get("/metrics", dependencies=viewer)
    def metrics() -> Response:
        """Return the state of `/v1/health` as Prometheus metrics."""
        registry = CollectorRegistry()
        registry.register(_Scraped(robot_metrics(health_of(collector))))
        if collector.bundles is not None:
            registry.register(_Scraped(_rollout_metrics(collector.bundles)))
        return Response(generate_latest(registry), media_type="text/plain; version=0.0.4; charset=utf-8")

    return router


class _Scraped(MetricSource):
    def __init__(self, metrics: Iterable[Metric]) -> None:
        self._metrics = metrics

    def collect(self) -> Iterable[Metric]:
        return self._metrics


def robot_metrics(health: FleetHealth) -> Iterator[Metric]:
    def gauge(name: str, help_text: str) -> GaugeMetricFamily:
        return GaugeMetricFamily(f"rosrv_fleet_{name}", help_text, labels=["robot"])

    age = gauge("segment_age_seconds", "seconds since the robot's newest segment arrived")
    ends = gauge("certificate_seconds", "seconds until the robot's certificate ends")
    silent = gauge("robot_silent", "1 while an appliance of the robot was not heard for silent_seconds")
    off = gauge("robot_off", "1 while an appliance of the robot is shut down cleanly, and none is silent")
    heard = GaugeMetricFamily(
        "rosrv_fleet_heard_seconds",
        "seconds since an appliance pushed a segment or stated that nothing waits",
        labels=["robot", "appliance"],
    )
    gaps = gauge("gaps", "places where segments of the robot are missing")
    forks = gauge("forks", "segments of the robot with a number that another one has")
    for robot in health.robots:
        if robot.age_seconds is not None:
            age.add_metric([robot.name], robot.age_seconds)
        ends.add_metric([robot.name], robot.certificate_seconds)
        silent.add_metric([robot.name], robot.silent)
        off.add_metric([robot.name], robot.off)
        for appliance, seconds in robot.heard_seconds.items():
            if seconds is not None:
                heard.add_metric([robot.name, appliance], seconds)
        gaps.add_metric([robot.name], robot.gaps)
        forks.add_metric([robot.name], robot.forks)
    yield from (age, ends, silent, off, heard, gaps, forks)
    yield GaugeMetricFamily(
        "rosrv_fleet_waiting", "stored segments that the index does not have", health.waiting
    )
    yield GaugeMetricFamily("rosrv_fleet_index_up", "1 while segments are indexed", health.trouble is None)
    yield GaugeMetricFamily("rosrv_fleet_disk_up", "1 while there is room for segments", health.disk is None)


def _rollout_metrics(service: BundleService) -> Iterator[Metric]:
    """Return the metrics of rollouts by group. No label has a robot's text, so robots cannot fill Prometheus."""
    robots = GaugeMetricFamily(
        "rosrv_fleet_robots", "robots of a group by condition", labels=["site", "group", "condition"]
    )
    state = GaugeMetricFamily(
        "rosrv_fleet_rollout",
        "1 for the state of a group's last rollout",
        labels=["site", "group", "state"],
    )
    for group in sorted({*service.rollouts, *service.robots}):
        found = group_state(service, group)
        for kind, count in found["conditions"].items():
            robots.add_metric([*group, kind], count)
        if found["rollout"] is not None:
            for one in get_args(RolloutState):
                state.add_metric([*group, one], found["rollout"]["state"] == one)
    yield from (robots, state)
    yield GaugeMetricFamily(
        "rosrv_fleet_rollouts_up", "1 while bundles are published and rollouts advance",
        service.advancing and not service.publisher.trouble,
    )  # fmt: skip
    if (expires := service.publisher.expires) is not None:
        left = expires - clock.wall()
        yield GaugeMetricFamily(
            "rosrv_fleet_metadata_expiry_seconds", "until the signed metadata expire", left
        )


_log = structlog.get_logger()


def bundle_router(collector: Collector) -> APIRouter:
    router = APIRouter()
    if collector.bundles is not None:
        reader, changer = (
            name_of(holder_of(collector.tokens, role)) for role in (FleetRole.VIEWER, FleetRole.OPERATOR)
        )
        router.include_router(robot_routes(collector.bundles, robot_of(collector.robots)))
        router.include_router(operator_routes(collector.bundles, reader, changer))
    return router


ROUTERS: tuple[Callable[[Collector], APIRouter], ...] = (
    push_router,
    join_router,
    search_router,
    health_router,
    console_router,
    evidence_router,
    bundle_router,
)
"""Each function returns the router of one part; a new part is added here."""


async def _damaged(_request: Request, error: Exception) -> Response:
    _log.error("a request failed", reason=str(error))
    return JSONResponse({"detail": "a file of the collector is damaged; see its log"}, 503)


def make_app(collector: Collector) -> FastAPI:
    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        collector.store.remove_unfinished()
        collector.evidence.remove_unfinished()
        for database in (collector.database, collector.searches.database):
            database.open()
        threads = [
            threading.Thread(target=collector.indexer.run, args=(lane,), daemon=True) for lane in LANES
        ]
        threads.append(threading.Thread(target=collector.pruner.run, daemon=True))
        for thread in threads:
            thread.start()
        bundles = [] if collector.bundles is None else [asyncio.create_task(collector.bundles.run())]
        try:
            yield
        finally:
            for task in bundles:
                task.cancel()
            await asyncio.gather(*bundles, return_exceptions=True)
            collector.indexer.stop()
            collector.pruner.stop()
            collector.workers.close()
            for thread in threads:
                await asyncio.to_thread(thread.join, 30.0)
            for database in (collector.database, collector.searches.database):
                database.close()

    app = FastAPI(title="ROSRV fleet collector", lifespan=lifespan, docs_url=None, redoc_url=None)
    app.add_exception_handler(DamagedFileError, _damaged)
    for make_router in ROUTERS:
        app.include_router(make_router(collector))
    return app
