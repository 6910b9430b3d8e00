"""Run charon, the IPsec daemon of the tunnels, which only this process talks to.

1. The private key stays in this process's own directory (mode 0600) and in charon.
2. charon has the privileges of this process: its own user, and the capabilities to change the network and to bind the
   ports 500 and 4500. Each dies with the other, and the supervisor starts both again.
3. The only untrusted input parsed here is charon's log; few of its refusals are passed on each second, the rest is
   counted.
4. Calls to charon are made one at a time: two calls on one session would read each other's answers.
"""

import asyncio
import os
import signal
import socket
import sys
from collections import Counter, deque
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import structlog

from appliance.base import clock
from appliance.base.atomic_files import write_whole
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.child_process import Child
from appliance.features.tunnels.charon import CharonError, ViciClient
from appliance.features.tunnels.refusals import REFUSED_SOURCES, Refusal, RefusalParser, RefusalShares
from appliance.ipsec.authority_key import SignerKeyError, require_private
from appliance.ipsec.leftovers import clear_leftovers
from appliance.ipsec.requests import fingerprint, make_key, signing_request
from appliance.ipsec.strongswan import PROGRAM, configuration

KEY_FILE = "appliance.key"
TUN = Path("/dev/net/tun")
REPORT_SECONDS = 2.0
RENEW_SECONDS = 30 * 86_400.0
_START_SECONDS = 15.0
_OUTPUT_LINES = 40
_LONGEST_LINE = 500  # characters
_LISTINGS = 5  # of the tunnels for one report

T = TypeVar("T")

_log = structlog.get_logger()


class TunnelProcess:
    """Handles messages of the supervisor and of control."""

    def __init__(self, lifeline: Channel, directory: Path, key: bytes) -> None:
        self._child = Child(lifeline, messages.TunnelLink, said=self._control_said, linked=self._on_link)
        self._directory = directory
        self._key = key
        self._ended = self._child.ended
        self._wanted: messages.TunnelsStated | None = None
        self._changed = asyncio.Event()
        self._taken = 0
        self._changes = 0  # of tunnels, told so far
        self._charon: asyncio.subprocess.Process | None = None
        self._vici: ViciClient | None = None
        self._one_at_a_time = asyncio.Lock()
        self._version = ""
        self._refusals = RefusalParser()
        self._packets: Counter[Refusal] = Counter()  # packets that ESP dropped since the last report
        self._shares = RefusalShares()
        self._tasks: set[asyncio.Future[Any]] = set()
        self._output: deque[str] = deque(maxlen=_OUTPUT_LINES)  # charon's last lines
        self.failed = False

    async def run(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._child.attach(messages.Ready())
        self._spawn(self._provision())
        self._spawn(self._report())
        self._spawn(self._renew())
        await self._ended.wait()
        for task in self._tasks:
            task.cancel()
        if self._charon is not None and self._charon.returncode is None:
            self._charon.terminate()
            await self._charon.wait()

    # --- messages of control ---

    def _on_link(self) -> None:
        self._ask()
        if self._vici is not None:
            self._say_what_it_is(self._vici)

    def _control_said(self, message: object) -> None:
        if isinstance(message, messages.TunnelsStated):
            self._wanted = message
            self._changed.set()

    def _ask(self) -> None:
        request = signing_request(self._key, messages.APPLIANCE_NAME)
        self._tell(messages.CertificateNeeded(request, fingerprint(self._key)))

    def _tell(self, message: messages.Message) -> None:
        self._child.tell(message)

    # --- charon ---

    async def _provision(self) -> None:
        while True:
            await self._changed.wait()
            self._changed.clear()
            wanted = self._wanted
            assert wanted is not None  # noqa: S101  set before the event
            if self._vici is None:
                self._vici = await self._start(wanted)
            vici = self._vici
            await self._in_turn(partial(vici.provision, wanted))
            self._taken = wanted.number
            await self._say_how_it_stands(vici)

    async def _start(self, wanted: messages.TunnelsStated) -> ViciClient:
        if wanted.esp == "user space" and (obstacle := tun_obstacle()):
            raise CharonError(obstacle)
        if wanted.esp == "kernel":
            await asyncio.to_thread(clear_leftovers, wanted.address)
        conf, sock = self._directory / "strongswan.conf", self._directory / "vici.sock"
        conf.write_text(configuration(self._directory, wanted.esp))
        sock.unlink(missing_ok=True)
        self._charon = await asyncio.create_subprocess_exec(
            "/usr/bin/setpriv",
            "--pdeathsig=SIGKILL",
            str(PROGRAM),
            env={"STRONGSWAN_CONF": str(conf), "PATH": "/usr/sbin:/usr/bin:/sbin:/bin"},
            stdin=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            limit=1 << 20,
        )
        self._spawn(self._read_log(self._charon))
        vici = await self._connect(sock)
        await self._in_turn(partial(vici.load_key, self._key))
        self._version = await self._in_turn(vici.version)
        self._say_what_it_is(vici)
        self._loop.run_in_executor(None, self._listen, vici)
        return vici

    async def _in_turn(self, call: Callable[[], T]) -> T:
        async with self._one_at_a_time:
            return await asyncio.to_thread(call)

    def _say_what_it_is(self, vici: ViciClient) -> None:
        self._tell(messages.CharonStarted(self._version, vici.proposals.key_exchange))

    async def _connect(self, path: Path) -> ViciClient:
        deadline = clock.now() + _START_SECONDS
        while True:
            try:
                return ViciClient(path)
            except CharonError:
                if clock.now() > deadline:
                    raise
            await asyncio.sleep(0.05)

    def _listen(self, vici: ViciClient) -> None:
        for host, up, remote in vici.listen():
            self._loop.call_soon_threadsafe(self._tell_change, messages.TunnelChanged(host, up, remote))

    def _tell_change(self, change: messages.TunnelChanged) -> None:
        self._changes += 1
        self._tell(change)

    async def _read_log(self, charon: asyncio.subprocess.Process) -> None:
        assert charon.stderr is not None  # noqa: S101  a pipe was asked for
        async for raw in charon.stderr:
            line = raw.decode("utf-8", "replace").rstrip()
            if line:
                self._output.append(line[:_LONGEST_LINE])
            refusal = self._refusals.read(line)
            if refusal is not None and refusal.packet:
                if refusal in self._packets or len(self._packets) < REFUSED_SOURCES:
                    self._packets[refusal] += 1
            elif refusal is not None and self._shares.passes(refusal, clock.now()):
                self._tell(messages.TunnelRefused(refusal.remote, refusal.reason))
        status = await charon.wait()
        how = f"by {signal.Signals(-status).name}" if status < 0 else f"with exit status {status}"
        raise CharonError(
            f"charon exited {how}; its last output: {self._output[-1] if self._output else 'nothing'}"
        )

    async def _report(self) -> None:
        while True:
            await asyncio.sleep(REPORT_SECONDS)
            for refusal, count in self._packets.items():
                self._tell(messages.TunnelRefused(refusal.remote, refusal.reason, count))
            self._packets.clear()
            for refusal in self._shares.rest():
                self._tell(messages.TunnelRefused(refusal.remote, refusal.reason))
            if self._vici is not None and not self._changed.is_set():
                await self._say_how_it_stands(self._vici)

    async def _say_how_it_stands(self, vici: ViciClient) -> None:
        """Report the tunnels. They are listed again if a tunnel changed in the meantime, because the list may be
        older.
        """
        for _ in range(_LISTINGS):
            changes = self._changes
            seen = await self._in_turn(vici.list_tunnels)
            if changes == self._changes:
                break
        self._tell(messages.TunnelsReported(self._taken, seen))

    async def _renew(self) -> None:
        while True:
            await asyncio.sleep(RENEW_SECONDS)
            self._ask()

    # --- tasks ---

    def _spawn(self, work: Awaitable[None]) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._on_finish)

    def _on_finish(self, task: "asyncio.Future[None]") -> None:
        self._tasks.discard(task)
        if task.cancelled() or self._ended.is_set():
            return
        error = task.exception()
        _log.error("the tunnels are restarted", reason=str(error))
        self._child.fail(str(error), list(self._output))
        self.failed = True
        self._ended.set()


def main(lifeline_fd: int, directory: Path) -> None:
    lifeline = Channel(socket.socket(fileno=lifeline_fd), messages.Lifeline)
    try:
        key = _own_key(directory / KEY_FILE)
    except (SignerKeyError, OSError) as error:
        lifeline.send(messages.Failed(f"the tunnels cannot use the appliance's key: {error}"))
        sys.exit(1)
    process = TunnelProcess(lifeline, directory, key)
    asyncio.run(process.run())
    # Do not join a thread that still waits for charon's answer; nothing is left to write.
    sys.stderr.flush()
    os._exit(1 if process.failed else 0)


def tun_obstacle() -> str:
    try:
        os.close(os.open(TUN, os.O_RDWR | os.O_CLOEXEC))
    except OSError as error:
        who = f"user {os.geteuid()}"
        return (
            f"{TUN} cannot be opened by {who}, which ESP in user space needs: {error.strerror};"
            f" load the kernel module `tun`, let {who} read and write the device, and restart the appliance"
        )
    return ""


def _own_key(path: Path) -> bytes:
    if not path.exists():
        write_whole(path, make_key(), 0o600)
    require_private(path)
    return path.read_bytes()
