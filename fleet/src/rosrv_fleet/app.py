"""Make the REST application of the collector from one router for each part of the API."""

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import structlog
from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.responses import JSONResponse

from rosrv_fleet.access import holder_of, name_of, robot_of
from rosrv_fleet.bundles.robot_routes import robot_routes
from rosrv_fleet.collector import Collector
from rosrv_fleet.console.routes import console_router
from rosrv_fleet.evidence.routes import evidence_router
from rosrv_fleet.health_routes import health_router
from rosrv_fleet.indexer import LANES
from rosrv_fleet.join_routes import join_router
from rosrv_fleet.push_routes import push_router
from rosrv_fleet.rollouts.operator_routes import operator_routes
from rosrv_fleet.search_routes import search_router
from rosrv_fleet.stored_files import DamagedFileError
from rosrv_fleet.tokens import FleetRole

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
