"""Robots and a collector in virtual time: the real pushers, logs, routes, store, judgement and alerts.

Doubles replace only the edges: the network, the processes of workers, and PostgreSQL. `pass_time` ends with a step of
each robot whose pause has ended, and a scrape.
"""

import math
import os
import random
import sqlite3
import ssl
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import psycopg
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from fastapi import APIRouter, HTTPException, Request
from fastapi.routing import APIRoute
from prometheus_client.core import Metric
from rosrv_fleet import collector, indexer, push_routes
from rosrv_fleet import collector as collector_module
from rosrv_fleet.access import PEER_CERTIFICATE
from rosrv_fleet.app import robot_metrics
from rosrv_fleet.collector import Collector, make_collector
from rosrv_fleet.config import FleetConfig, Limits, RetentionConfig
from rosrv_fleet.enrolment import Robot
from rosrv_fleet.health import health_of
from rosrv_fleet.indexer import LANES
from rosrv_fleet.push_routes import push_router
from rosrv_fleet.receipt_key import make_receipt_key
from rosrv_fleet.robots import Robots

from appliance.audit.log.log import AuditLog
from appliance.audit.log.retention import Retention
from appliance.audit.log.signatures import read_public_key
from appliance.base import clock
from appliance.features.fleet.connection import CollectorConnection, CollectorError, robot_context
from appliance.features.fleet.segment_process import SegmentPusher
from appliance.ipsec.signer import RemovalRefusedError, RetentionLimits
from appliance.signing.own_certificate import make_own_certificate
from fleet.tests.support.collectors import InlineWorkers
from tests.support.alert_rules import Alert, FleetAlerts
from tests.support.audit import decision, settle
from tests.support.autojump import run
from tests.support.engines import ByHand
from tests.support.virtual_clock import ShiftedClock, VirtualClock
from tests.unit.audit.conftest import Notary

_BUSY_SECONDS = 600.0  # after a record; later turns of a log without retention would do nothing
_DEADLINE = 60.0  # of an exchange without an answer


class _Cable(CollectorConnection):
    """The connection of a robot: each new one reads the certificate's files, as the real one does."""

    def __init__(self, night: "FleetNight", robot: "NightRobot") -> None:
        self._night = night
        self._robot = robot
        self._far: RunningCollector | None = None

    @property
    def is_open(self) -> bool:
        return self._far is not None and self._far is self._night.collector

    def close(self) -> None:
        self._far = None

    def get(self, path: str, longest: int = 0) -> bytes:
        return self._ask(lambda far, robot: far.get(path, robot))

    def put(self, path: str, content: Iterator[bytes], size: int, headers: Any = ()) -> bytes:
        body = b"".join(content)
        return self._ask(lambda far, robot: far.put(path, body, robot))

    def _ask(self, ask: Callable[["RunningCollector", bytes], bytes]) -> bytes:
        if self._robot.is_cut:
            self._robot.due = clock.now() + _DEADLINE
            raise CollectorError(f"the collector takes more than {_DEADLINE:g} s")
        if not self.is_open:
            robot_context(self._night.ca, self._robot.certificate, self._robot.tls_key)
            self._far = self._night.collector
        if self._far is None:
            raise CollectorError("Connection refused")
        shown = ssl.PEM_cert_to_DER_cert(self._robot.certificate.read_text())
        try:
            with clock.using(self._night.clock):
                return ask(self._far, shown)
        except HTTPException as error:
            wait = float((error.headers or {}).get("Retry-After", 0))
            reason = f"the collector answers {error.status_code}: {error.detail}"
            raise CollectorError(reason, error.status_code, wait) from error


class RunningCollector:
    """A started collector, without its server: requests call the functions of its routes."""

    def __init__(self, config: FleetConfig) -> None:
        self.parts: Collector = make_collector(config)
        self.parts.robots.known()
        self._routes = _endpoints(push_router(self.parts))
        self._due = {**dict.fromkeys(LANES, 0.0), "retention": 0.0}

    def get(self, path: str, certificate: bytes) -> bytes:
        log, _, query = path.removeprefix("v1/logs/").partition("?")
        asked = dict(word.split("=") for word in query.split("&"))
        flags = {name: asked.get(name) == "true" for name in ("idle", "off")}
        request = _request(certificate)
        answer = self._routes["head"](request, log, self._robot(certificate), int(asked["upto"]), **flags)
        return bytes(answer.body)

    def put(self, path: str, body: bytes, certificate: bytes) -> bytes:
        _v1, _logs, log, _segments, number, name = path.split("/")
        request = _request(certificate, body)
        answer = run(self._routes["put"](request, log, int(number), name, self._robot(certificate)))
        return bytes(answer.body)

    def _robot(self, certificate: bytes) -> Robot:
        robot = self.parts.robots.with_certificate(certificate)
        if robot is None:
            raise HTTPException(403, "this certificate belongs to no enrolled robot")
        return robot

    def metrics(self) -> list[Metric]:
        return list(robot_metrics(health_of(self.parts)))

    def work(self) -> None:
        """Let the threads of the index and of retention take the turns that are due."""
        turns: dict[str, Callable[[], float]] = {
            lane: partial(self.parts.indexer.turn, lane) for lane in LANES
        }
        turns["retention"] = self.parts.pruner.turn
        for name, turn in turns.items():
            while self._due[name] <= clock.now():
                self._due[name] = clock.now() + turn()


class NightRobot:
    def __init__(self, night: "FleetNight", name: str, *, kept_days: float | None, ahead: float) -> None:
        folder = night.folder / name
        folder.mkdir()
        self.name = name
        self.ahead = ahead
        self.is_cut = self.signs = False
        self.due = 0.0
        self.certificate, self.tls_key = folder / "robot.pem", folder / "robot.key"
        self._night = night
        self._chance = random.Random(name)  # noqa: S311  jitter, no secrets
        self._key = Ed25519PrivateKey.generate()
        self._public = self._key.public_key().public_bytes_raw()
        self._notary = Notary(folder / "notary")
        self._notary.kept = RetentionLimits(days=kept_days)
        self._file = folder / "audit.db"
        with clock.using(self.clock):
            self.log = AuditLog(
                self._file, signer=self._sign, removals=self._approve, retention=Retention(days=kept_days),
                drive=ByHand,
            )  # fmt: skip
        self.sign_again()
        self._busy_until = math.inf if kept_days else 0.0
        (folder / "state").mkdir()
        self._state = folder / "state"
        self.make_certificate()
        public = self._key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
        night.robots_file.add(name, public, self.certificate.read_bytes())
        self.pusher: SegmentPusher | None = None
        self.start()

    @property
    def clock(self) -> clock.ClockSource:
        with clock.using(self._night.clock):
            return ShiftedClock(self.ahead)

    def make_certificate(self) -> None:
        key, certificate = make_own_certificate(self.name, 825)
        self.tls_key.write_bytes(key)
        self.certificate.write_bytes(certificate)

    def renew(self) -> None:
        with clock.using(self._night.clock):
            self.make_certificate()
            self._night.robots_file.renew(self.name, self.certificate.read_bytes())

    def start(self) -> None:
        cable = _Cable(self._night, self)
        self.pusher = SegmentPusher(
            self._file, self._state, cable, self._night.receipt_key, jitter=self._chance.random
        )
        self.due = 0.0

    def switch_off(self) -> None:
        assert self.pusher is not None
        with clock.using(self.clock):
            self.pusher.close(stopped=True)
        self.pusher = None

    def unplug(self) -> None:
        self.pusher = None

    def step(self) -> None:
        with clock.using(self.clock):
            if clock.now() < self._busy_until:
                for _turn in range(2):  # the second one stores the signatures that the first one asked for
                    self.log.turn(clock.now())
            while self.pusher is not None and self.due <= clock.now():
                self.due = max(self.due, clock.now() + self.pusher.step())

    def record(self, count: int) -> None:
        with clock.using(self.clock):
            for number in range(count):
                self.log.record(decision(self.log, number))
            assert settle(self.log) is None
            self._busy_until = max(self._busy_until, clock.now() + _BUSY_SECONDS)

    def edit_log(self) -> None:
        with closing(sqlite3.connect(self._file)) as log, log:
            (newest,) = log.execute("SELECT max(sequence) FROM record WHERE event = 'decision'").fetchone()
            log.execute("UPDATE record SET caller_id = '/edited' WHERE sequence = ?", (newest,))

    def sign_again(self) -> None:
        self.signs = True
        self.log.request_signatures()

    def _sign(self, number: int, text: bytes, *, oldest: bool) -> None:
        if self.signs:
            self._notary.sign(text)
            self.log.store_signature(number, self._key.sign(text), self._public)

    def _approve(self, number: int, checkpoint: bytes, newest: bytes) -> None:
        try:
            text = self._notary.accept(checkpoint, newest)
        except RemovalRefusedError as error:
            self.log.removal_refused(number, str(error), early=error.early)
        else:
            self.log.removal_signed(number, text, self._key.sign(text), self._public)


class FleetNight:
    """A collector with its robots. `fired` has the seconds at which each alert fired first."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, wall: float) -> None:
        self.folder = folder
        self.clock = VirtualClock(wall=wall)
        self.robots: dict[str, NightRobot] = {}
        self.fired: dict[Alert, float] = {}
        self.untrue: list[tuple[float, str]] = []
        self.database_is_up = True
        self.indexed = 0
        self._reachable: dict[str, float] = {}
        """The last time at which each robot ran with a whole cable."""
        self._alerts = FleetAlerts()
        self._scraped: list[Metric] = []
        self._began = self.clock.now_ns()
        data = folder / "data"
        data.mkdir()
        self.robots_file = Robots(data / "robots")
        self.receipt_key = read_public_key(make_receipt_key(data))
        self.ca = folder / "ca.pem"
        self.ca.write_bytes(make_own_certificate("collector", 3650, "127.0.0.1")[1])
        self._config = FleetConfig(
            data=data, certificate=self.ca, key=self.ca, limits=Limits(reserve_bytes=1),
            retention=RetentionConfig(index_days=1),
        )  # fmt: skip
        self.collector: RunningCollector | None = None
        for module, name, double in (
            (collector_module, "Workers", InlineWorkers), (push_routes, "processor_time", nullcontext),
            (psycopg, "connect", self._connect), (indexer, "migrate", lambda _connection: []),
            (indexer, "is_complete", lambda _connection: True), (indexer, "too_few_locks", lambda *_arguments: ""),
            (indexer, "_index_one", self._index), (collector, "drop_partitions", self._drop),
        ):  # fmt: skip
            monkeypatch.setattr(module, name, double)
        monkeypatch.setattr(os, "fsync", lambda _descriptor: None)  # no power cut is simulated

    @property
    def now(self) -> float:
        return (self.clock.now_ns() - self._began) / 1e9

    # --- the double of PostgreSQL ---

    @contextmanager
    def _connect(self, *_conninfo: object, **_named: object) -> Iterator[None]:
        if not self.database_is_up:
            raise psycopg.OperationalError("connection refused")
        yield None

    def _index(self, *_arguments: object) -> None:
        with self._connect():
            self.indexed += 1

    def _drop(self, *_arguments: object) -> list[object]:
        with self._connect():
            return []

    # --- the course of the night ---

    def add_robot(self, name: str, *, kept_days: float | None = None, ahead: float = 0.0) -> NightRobot:
        with clock.using(self.clock):
            self.robots[name] = NightRobot(self, name, kept_days=kept_days, ahead=ahead)
        return self.robots[name]

    def start_collector(self, **limits: int) -> None:
        self._config = msgspec.structs.replace(
            self._config, limits=msgspec.structs.replace(self._config.limits, **limits)
        )
        with clock.using(self.clock):
            self.collector = RunningCollector(self._config)

    def stop_collector(self) -> None:
        self.collector = None

    def pass_time(self, seconds: float) -> None:
        self.clock.advance(seconds)
        with clock.using(self.clock):
            for robot in self.robots.values():
                robot.step()
                if not robot.is_cut and robot.pusher is not None:
                    self._reachable[robot.name] = self.now
            if self.collector is not None:
                self.collector.work()
            self._scrape()

    def off(self) -> list[str]:
        """Return the robots that the last scrape called switched off."""
        return _robots_of("rosrv_fleet_robot_off", self._scraped)

    def _scrape(self) -> None:
        families = None if self.collector is None else self.collector.metrics()
        for alert in self._alerts.firing(clock.now(), families):
            self.fired.setdefault(alert, self.now)
        self._scraped = families or []
        silent = _robots_of("rosrv_fleet_robot_silent", self._scraped)
        self.untrue += [(self.now, name) for name in silent if self._reachable[name] == self.now]


def _endpoints(router: APIRouter) -> dict[str, Callable[..., Any]]:
    return {route.name: route.endpoint for route in router.routes if isinstance(route, APIRoute)}


def _robots_of(name: str, metrics: list[Metric]) -> list[str]:
    (found,) = (family.samples for family in metrics if family.name == name) if metrics else ([],)
    return [sample.labels["robot"] for sample in found if sample.value]


def _request(certificate: bytes, body: bytes = b"") -> Request:
    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": body, "more_body": False}

    headers = [(b"content-encoding", b"gzip")]
    return Request({"type": "http", "state": {PEER_CERTIFICATE: certificate}, "headers": headers}, receive)
