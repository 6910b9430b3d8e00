import asyncio
import os
import signal
import socket
import sqlite3
import ssl
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import yaml
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from rosrv_fleet.robots import Robots

from appliance.audit.log.log import AuditLog
from appliance.audit.log.signatures import read_public_key, write_public_key
from appliance.audit.proof.copies import signed_checkpoints
from appliance.configuration.config_sources import resolve
from appliance.features.fleet.connection import robot_connection
from appliance.features.fleet.segment_process import SegmentPusher
from appliance.features.fleet.settings import Fleet
from tests.support.audit import decision, settle
from tests.support.certificates import Certificates, make_certificates
from tests.support.sources import ROOT
from tests.support.waiting import NoAnswerError, eventually


@dataclass
class FleetSite:
    folder: Path
    database: str
    limits: dict[str, Any] = field(default_factory=dict)
    data: Path | None = None
    address: str = "127.0.0.1"
    popen: Callable[..., subprocess.Popen[bytes]] = subprocess.Popen  # on the host with this address

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self.data = self.data or self.folder / "data"
        self.server = make_certificates(self.folder / "server", self.address)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.write_config()
        self._process: subprocess.Popen[bytes] | None = None
        self.run("init")
        self.token = self.run("token", "add", "tester").stdout.strip()

    def write_config(self, **changes: Any) -> None:
        config = {
            "data": str(self.data), "listen": f"{self.address}:{self.port}", "database": self.database,
            "certificate": str(self.server.certificate), "key": str(self.server.key),
            "limits": {"reserve_bytes": 1} | self.limits,
        }  # fmt: skip
        (self.folder / "fleet.yaml").write_text(yaml.safe_dump(config | changes))

    def command(self, *arguments: str) -> list[str]:
        return [sys.executable, "-m", "rosrv_fleet", *arguments, "--config", str(self.folder / "fleet.yaml")]

    def run(self, *arguments: str, status: int = 0) -> subprocess.CompletedProcess[str]:
        environment = os.environ | {"PYTHONPATH": str(ROOT / "fleet" / "src")}
        done = subprocess.run(
            self.command(*arguments), capture_output=True, text=True, check=False, env=environment
        )
        assert done.returncode == status, f"{arguments}: {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done

    def start(self) -> None:
        environment = os.environ | {"PYTHONPATH": str(ROOT / "fleet" / "src")}
        with (self.folder / "log").open("ab") as log:
            self._process = self.popen(self.command("serve"), stderr=log, env=environment)
        eventually(
            self._answers, lambda: f"the collector answers: {(self.folder / 'log').read_text()[-2000:]}"
        )

    def _answers(self) -> bool:
        assert self._process is None or self._process.poll() is None, (self.folder / "log").read_text()[
            -3000:
        ]
        try:
            return self.get("/healthz", token=None).status_code == 200
        except httpx.TransportError:
            return False

    def stop(self, with_signal: int = signal.SIGTERM) -> None:
        if self._process is not None:
            self._process.send_signal(with_signal)
            self._process.wait(60)
            self._process = None

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def kill(self) -> None:
        self.stop(signal.SIGKILL)

    def get(self, path: str, token: str | None = "", **parameters: Any) -> httpx.Response:
        headers = {} if token is None else {"Authorization": f"Bearer {token or self.token}"}
        with self.client() as client:
            return client.get(path, headers=headers, params=parameters)

    def client(self, robot: Certificates | None = None) -> httpx.Client:
        context = ssl.create_default_context(cafile=self.server.ca)
        if robot is not None:
            context.load_cert_chain(robot.certificate, robot.key)
        return httpx.Client(base_url=f"https://127.0.0.1:{self.port}", verify=context, timeout=60)

    def answer(self, path: str, **parameters: Any) -> dict[str, Any]:
        found = self.get(path, **parameters)
        if found.status_code in (429, 503):
            raise NoAnswerError(found.text)
        assert found.status_code == 200, found.text
        return dict(found.json())

    def search(self, **words: Any) -> list[dict[str, Any]]:
        records: list[dict[str, Any]] = self.answer("/v1/search", **words)["records"]
        return records

    def all(self, **words: Any) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = []
        more: dict[str, str] = {}
        while True:
            page = self.answer("/v1/search", limit=1000, **words, **more)
            found += page["records"]
            if page["cursor"] is None:
                return found
            more = {"cursor": page["cursor"]}

    def stored(self) -> int:
        assert self.data is not None
        return sum(1 for _file in (self.data / "segments").rglob("*.gz"))

    def health(self) -> dict[str, Any]:
        return self.answer("/v1/health")

    def indexed(self) -> None:
        eventually(
            lambda: self.health()["waiting"] == 0 and self.health()["trouble"] is None, "all is indexed"
        )

    @property
    def receipt_key(self) -> bytes:
        assert self.data is not None
        return read_public_key(self.data / "receipts.pub")


class FleetRobot:
    def __init__(
        self, site: FleetSite, name: str, *, enrolled: bool = True, every: int = 10, group: str = ""
    ) -> None:
        self.site, self.name = site, name
        self.folder = site.folder / "robots" / name
        self.folder.mkdir(parents=True)
        (self.folder / "state").mkdir()
        self.log_file = self.folder / "audit.db"
        self.key = Ed25519PrivateKey.generate()
        self.public = self.key.public_key().public_bytes_raw()
        self.certificates = make_certificates(self.folder / "tls", authority=f"authority of {name}")
        write_public_key(self.folder / "audit.pub.pem", self.public)
        self._every = every
        self._open()
        if enrolled:
            assert site.data is not None
            key, certificate = self.folder / "audit.pub.pem", self.certificates.certificate
            Robots(site.data / "robots").add(name, key.read_bytes(), certificate.read_bytes(), group)
            eventually(self.is_trusted, "the running collector notices the robot")

    def _open(self) -> None:
        self.log = AuditLog(
            self.log_file, checkpoint_every=self._every, checkpoint_seconds=86_400, signer=self._sign
        )
        self.log.request_signatures()

    def rewind(self, number: int) -> None:
        with sqlite3.connect(self.log_file) as log:
            (sequence,) = log.execute(
                "SELECT sequence FROM checkpoint WHERE number = ?", (number,)
            ).fetchone()
            log.execute("DELETE FROM checkpoint WHERE number > ?", (number,))
            log.execute("DELETE FROM record WHERE sequence > ?", (sequence,))
        log.close()
        self._open()

    def is_trusted(self) -> bool:
        try:
            with self.site.client(self.certificates) as client:
                return client.get(f"/v1/logs/{'0' * 32}").status_code == 200
        except httpx.TransportError:
            return False

    def _sign(self, number: int, text: bytes, *, oldest: bool) -> None:
        log = getattr(self, "log", None)
        if log is not None:
            log.store_signature(number, self.key.sign(text), self.public)

    def record(self, count: int, **changes: Any) -> None:
        for number in range(count):
            self.log.record(decision(self.log, number, **changes))
            if number % 10 == 9:
                settle(self.log)
        asyncio.run(asyncio.wait_for(self.log.wait_signed(), 60))

    def sealed(self) -> int:
        return signed_checkpoints(self.log_file, 0, 1_000_000)[-1].sequence

    def pusher(self) -> SegmentPusher:
        tls = self.certificates
        url = f"https://127.0.0.1:{self.site.port}"
        collector = robot_connection(url, self.site.server.ca, tls.certificate, tls.key)
        return SegmentPusher(self.log_file, self.folder / "state", collector, self.site.receipt_key)

    def push(self) -> SegmentPusher:
        pusher = self.pusher()
        while pusher.step() == 0:
            pass
        assert not pusher.progress.trouble, pusher.progress.trouble
        pusher.close()
        return pusher

    def close(self) -> None:
        self.log.close()


def push_joined(robot: FleetRobot, state: Path) -> None:
    fleet = resolve(None, {}, {"state": state}).of(Fleet)
    assert fleet.receipt_key
    link = robot_connection(*fleet.connection)
    pusher = SegmentPusher(robot.log_file, robot.folder / "state", link, read_public_key(fleet.receipt_key))
    eventually(lambda: pusher.step() > 0 and not pusher.progress.trouble, lambda: pusher.progress.trouble)
    pusher.close()


@contextmanager
def running(site: FleetSite) -> Iterator[FleetSite]:
    try:
        site.start()
        yield site
    finally:
        site.kill()
