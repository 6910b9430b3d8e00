import asyncio
import threading
import time
from collections.abc import Coroutine, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, TypeVar

import psycopg
import uvicorn
from fastapi import FastAPI, HTTPException, Request
from rosrv_fleet.bundles.repository import TIMESTAMP_KEY
from rosrv_fleet.bundles.robot_routes import robot_routes
from rosrv_fleet.database import IndexDatabase, migrate
from rosrv_fleet.enrolment import Robot, RobotGroup
from rosrv_fleet.rollouts.operator_routes import operator_routes
from rosrv_fleet.rollouts.service import BundleService
from rosrv_fleet.rollouts.store import RolloutStore
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from fleet.tests.support.fleet_certificates import FleetAuthority

T = TypeVar("T")


class _Protocol(HttpToolsProtocol):
    def on_message_begin(self) -> None:
        super().on_message_begin()
        certificate = self.transport.get_extra_info("peercert") or {}
        names = dict(pair[0] for pair in certificate.get("subject", ()))
        self.scope.setdefault("state", {})["robot"] = names.get("commonName", "")


def _operator(request: Request) -> str:
    if request.state.robot != "operator":
        raise HTTPException(403, "for operators")
    return "operator"


class RolloutCollector:
    def __init__(self, folder: Path, authority: FleetAuthority, address: str, ahead: float = 0) -> None:
        self._address = address
        self._ahead = ahead
        self.groups: dict[str, RobotGroup] = {}
        self._authority = authority
        self.folder = folder
        self.loop = asyncio.new_event_loop()
        self.service: BundleService
        self.url = ""
        self._started = threading.Event()
        self._thread = threading.Thread(target=self.loop.run_until_complete, args=(self._run(),), daemon=True)

    def enrol(self, group: RobotGroup, *names: str) -> None:
        self.groups |= dict.fromkeys(names, group)

    def _robot(self, request: Request) -> Robot:
        name = str(request.state.robot)
        if not name:
            raise HTTPException(401, "a robot proves who it is with its certificate")
        group = str(self.groups.get(name, ""))
        return Robot(name=name, group=group, key="", certificate="", added=0)

    def call(self, work: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(60)

    def start(self) -> None:
        self._thread.start()
        assert self._started.wait(30)

    def stop(self) -> None:
        self._server.should_exit = True
        self._thread.join(20)
        self.loop.close()

    async def _run(self) -> None:
        with psycopg.connect(self._address) as connection:
            migrate(connection)
        database = IndexDatabase(self._address, connections=8, statement_seconds=30)
        database.open()
        with closing(database):
            self.service = BundleService(
                self.folder, self.folder / TIMESTAMP_KEY, RolloutStore(database), lambda: self.groups,
                lambda: time.time() + self._ahead,
            )  # fmt: skip
            app = FastAPI()
            app.include_router(robot_routes(self.service, self._robot))
            app.include_router(operator_routes(self.service, _operator, _operator))
            config = uvicorn.Config(
                app, host="127.0.0.1", port=0, http=_Protocol, log_level="warning", lifespan="off", backlog=2048,
                timeout_graceful_shutdown=1, timeout_keep_alive=90,
            )  # fmt: skip
            config.load()
            config.ssl = self._authority.server_context
            self._server = uvicorn.Server(config)
            work = asyncio.create_task(self.service.run())
            serving = asyncio.create_task(self._serve())
            await serving
            work.cancel()
            await asyncio.gather(work, return_exceptions=True)
            await asyncio.get_running_loop().shutdown_default_executor()

    async def _serve(self) -> None:
        async def announce() -> None:
            while not self._server.started:
                await asyncio.sleep(0.02)
            port = self._server.servers[0].sockets[0].getsockname()[1]
            self.url = f"https://127.0.0.1:{port}"
            self._started.set()

        await asyncio.gather(self._server.serve(), announce())


@contextmanager
def serving(made: RolloutCollector) -> Iterator[RolloutCollector]:
    made.start()
    try:
        yield made
    finally:
        made.stop()


@contextmanager
def collector(folder: Path, authority: FleetAuthority, address: str) -> Iterator[RolloutCollector]:
    with serving(RolloutCollector(folder, authority, address)) as made:
        yield made
