"""Robots for `benchmarks.fleet_night`: a real log, the real process of the pusher, and a cable that can be cut."""

import asyncio
import socket
import sqlite3
import subprocess
import sys
from contextlib import closing, suppress

import msgspec
from rosrv_fleet.robots import Robots

from appliance.audit.log.log import AuditLog
from appliance.audit.log.retention import Retention
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.messages import ForwardingReported, LinkOpened, Stop
from appliance.configuration.config_sources import resolve
from appliance.ipsec.signer import RemovalRefusedError, RetentionLimits
from appliance.signing.own_certificate import make_own_certificate
from fleet.tests.support.fleet_site import FleetRobot, FleetSite
from tests.support.audit import decision
from tests.support.sources import ROOT
from tests.unit.audit.conftest import Notary

_KEPT_DAYS = 0.01  # a quarter of an hour: the night has many removals
_AGENT = """
import sys
from pathlib import Path
from appliance.base import clock
from appliance.features.fleet import segment_process
from tests.support.virtual_clock import ShiftedClock
with clock.using(ShiftedClock(float(sys.argv[3]))):
    segment_process.main(int(sys.argv[1]), Path(sys.argv[2]))
"""


class Cable:
    """Passes the bytes of a robot's connections to the collector. While cut, it holds them, and closes nothing."""

    def __init__(self, port: int) -> None:
        self._to = port
        self._whole = asyncio.Event()
        self._whole.set()
        self.port = 0

    async def lay(self) -> None:
        server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.port = server.sockets[0].getsockname()[1]

    def cut(self) -> None:
        self._whole.clear()

    def join(self) -> None:
        self._whole.set()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            await self._whole.wait()
            far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._to)
            await asyncio.gather(self._pass(reader, far_writer), self._pass(far_reader, writer))
        writer.close()

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            while data := await reader.read(65_536):
                await self._whole.wait()
                writer.write(data)
                await writer.drain()
        writer.close()


class ParkedRobot(FleetRobot):
    """A robot, enrolled with a certificate such as `rosrv fleet join` makes. Only the loop's thread may call it."""

    def __init__(self, site: FleetSite, name: str, *, removes: bool, ahead: float) -> None:
        """`removes`: retention removes records after a quarter of an hour. Its clock is `ahead` by some seconds."""
        self.cable = Cable(site.port)
        self.report = ForwardingReported()
        self.ahead = ahead
        self.signs = True
        self.lock = asyncio.Lock()  # held while something is wrong with it
        self._limits = RetentionLimits(days=_KEPT_DAYS if removes else None)
        self._notary: Notary | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._lifeline: Channel | None = None
        super().__init__(site, name, enrolled=False)
        self._write_certificate()
        self._robots.add(
            name, (self.folder / "audit.pub.pem").read_bytes(), self.certificates.certificate.read_bytes()
        )
        (self.folder / "appliance").mkdir()
        (self.folder / "appliance" / "control").symlink_to(self.folder)

    @property
    def _robots(self) -> Robots:
        assert self.site.data is not None
        return Robots(self.site.data / "robots")

    def _write_certificate(self) -> None:
        key, certificate = make_own_certificate(self.name, 825)
        self.certificates.key.write_bytes(key)
        self.certificates.certificate.write_bytes(certificate)

    def renew(self) -> None:
        self._write_certificate()
        self._robots.renew(self.name, self.certificates.certificate.read_bytes())

    # --- its log ---

    def _open(self) -> None:
        self._notary = Notary(self.folder / "notary")
        self._notary.kept = self._limits
        self.log = AuditLog(
            self.log_file, signer=self._sign, removals=self._approve, retention=Retention(self._limits.days)
        )
        self.log.request_signatures()

    def _sign(self, number: int, text: bytes, *, oldest: bool) -> None:
        if self.signs and self._notary is not None:
            self._notary.sign(text)
            super()._sign(number, text, oldest=oldest)

    def _approve(self, number: int, checkpoint: bytes, newest: bytes) -> None:
        assert self._notary is not None
        try:
            text = self._notary.accept(checkpoint, newest)
        except RemovalRefusedError as error:
            self.log.removal_refused(number, str(error), early=error.early)
        else:
            self.log.removal_signed(number, text, self.key.sign(text), self.public)

    def note(self, count: int) -> None:
        """Record decisions, without waiting for their checkpoint."""
        for number in range(count):
            self.log.record(decision(self.log, number))

    def edit_log(self) -> None:
        """Change the newest decision behind the back of the log."""
        with closing(sqlite3.connect(self.log_file)) as log, log:
            (newest,) = log.execute("SELECT max(sequence) FROM record WHERE event = 'decision'").fetchone()
            log.execute("UPDATE record SET caller_id = '/edited' WHERE sequence = ?", (newest,))

    # --- its process ---

    async def start(self) -> None:
        if not self.cable.port:
            await self.cable.lay()
        config = self.folder / "config.json"
        config.write_bytes(msgspec.json.encode(self._settings(), enc_hook=str))
        (ours, theirs), (link, far_link) = socket.socketpair(), socket.socketpair()
        with (self.folder / "agent.log").open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _AGENT, str(theirs.fileno()), str(config), str(self.ahead)],
                cwd=self.folder / "state", env={"PYTHONPATH": f"{ROOT}:{ROOT / 'fleet/src'}"},
                pass_fds=[theirs.fileno()], stdout=log, stderr=log,
            )  # fmt: skip
        theirs.close()
        loop = asyncio.get_running_loop()
        self._lifeline = Channel(ours, messages.Lifeline)
        self._lifeline.attach(loop, lambda _message, _descriptors: None, lambda: None)
        Channel(link, messages.ForwardingLink).attach(loop, self._reported, lambda: None)
        self._lifeline.send(LinkOpened("control", 0), (far_link.fileno(),))
        far_link.close()

    def _settings(self) -> object:
        tls, keys = self.certificates, self.site
        assert keys.data is not None
        fleet = {
            "collector": f"https://127.0.0.1:{self.cable.port}", "ca": str(keys.server.ca), "robot": self.name,
            "certificate": str(tls.certificate), "key": str(tls.key),
            "receipt_key": str(keys.data / "receipts.pub"),
        }  # fmt: skip
        file = self.folder / "appliance.yaml"
        settings = {"state": str(self.folder / "appliance"), "isolation": "none", "fleet": fleet}
        file.write_bytes(msgspec.yaml.encode(settings))
        return resolve(file, {}, {})

    def _reported(self, report: messages.Message, _descriptors: tuple[int, ...]) -> None:
        assert isinstance(report, ForwardingReported)
        self.report = report

    @property
    def pid(self) -> int | None:
        return None if self._process is None else self._process.pid

    async def switch_off(self) -> None:
        """End the process as the supervisor does when the machine is switched off."""
        assert self._lifeline is not None
        self._lifeline.send(Stop())
        await self._ended()

    async def kill(self) -> None:
        assert self._process is not None
        self._process.kill()
        await self._ended()

    async def _ended(self) -> None:
        assert self._process is not None
        assert self._lifeline is not None
        await asyncio.to_thread(self._process.wait, 30)
        self._lifeline.close()
        self._process = self._lifeline = None
