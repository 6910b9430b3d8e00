"""Run the api process: its lifeline, its link to control, its certificate, and the listener.

It outlives control. Routes and contract are made when a request first passes the gate, so an unused api is small.
"""

import asyncio
import datetime
import os
import socket
import ssl
import sys
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from ipaddress import ip_network
from pathlib import Path

import structlog
import uvloop
from starlette.types import ASGIApp, Receive, Scope, Send

from appliance.api.front.access import TokenAuthenticator
from appliance.api.front.certificate import fingerprint_of, pin_of, renew, tls_context
from appliance.api.front.control import ControlLink
from appliance.api.front.etags import ConditionalGet
from appliance.api.front.history import SampleHistory, measures_of
from appliance.api.front.journal import FOLD_SECONDS, Journal
from appliance.api.front.listener import Listener
from appliance.api.front.request_gate import RequestGate
from appliance.api.front.services import Services
from appliance.api.front.websockets import WebSocketHandover
from appliance.base import clock
from appliance.base.background import run_always
from appliance.base.head_requests import AnswersHead
from appliance.channel import messages
from appliance.channel.channel import Channel, ChannelClosedError
from appliance.channel.messages.api import ApiLink
from appliance.configuration.settings import Settings, load_resolved

_log = structlog.get_logger()
_WITHOUT_CONTROL_SECONDS = 30.0
_RENEW_SECONDS = 60.0
_THREADS = 40
_SWITCH_SECONDS = 0.0005  # a thread that judges a large text lets the loop run after this time


def main(lifeline_fd: int, config: Path) -> None:
    sys.setswitchinterval(_SWITCH_SECONDS)
    uvloop.run(_Api(load_resolved(config), lifeline_fd).run())


class _Application:
    def __init__(self, services: Services) -> None:
        self._services = services
        self._made: ASGIApp | None = None
        self._making = asyncio.Lock()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async with self._making:
            if self._made is None:
                self._made = await asyncio.to_thread(self._make)
        await self._made(scope, receive, send)

    def _make(self) -> ASGIApp:
        from appliance.api.app import build_app  # noqa: PLC0415  only for a process that is asked

        return build_app(self._services)


class _Api:
    def __init__(self, settings: Settings, lifeline_fd: int) -> None:
        self._settings = settings
        self._lifeline = Channel(socket.socket(fileno=lifeline_fd), messages.Lifeline)
        self._doorkeeper = TokenAuthenticator(settings.api_limits.failures_per_minute, self._token_used)
        self._control = ControlLink(
            self._doorkeeper.state, self._await_control, blocks_stated=self._doorkeeper.state_blocks
        )
        self._journal = Journal(self._control.tell)
        self._stopping = asyncio.Event()
        self._given = asyncio.Event()
        self._socket: socket.socket | None = None
        self._without_control: asyncio.TimerHandle | None = None

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        # There are more threads than concurrent tasks, so a verification of the log never delays the check of a token.
        loop.set_default_executor(ThreadPoolExecutor(_THREADS, "api"))
        self._lifeline.attach(loop, self._on_message, self._end)
        history = SampleHistory(lambda: measures_of(self._control))
        services = Services(
            self._settings, self._control, self._doorkeeper, self._journal, self._stopping, history
        )
        gate = RequestGate(
            ConditionalGet(_Application(services)),
            limits=self._settings.api_limits,
            doorkeeper=self._doorkeeper,
            journal=self._journal,
            names=[
                *self._settings.rest_names,
                *filter(None, [self._settings.ipsec.endpoint]),  # the address for hosts that enrol themselves
                socket.gethostname(),
            ],
            tunnels=self._settings.ipsec.pool,
            networks=map(ip_network, self._settings.api_networks),
        )
        handover = WebSocketHandover(self._control, self._doorkeeper, gate)
        listener = Listener(
            AnswersHead(gate), self._settings.api_limits, self._doorkeeper.quota_class, handover
        )
        await self._given.wait()
        if self._socket is None:
            return
        try:
            context = await asyncio.to_thread(self._context) if self._settings.api_tls else None
            if context is not None:
                self._state_served()
            await listener.start(self._socket, context)
        except (OSError, ValueError) as error:
            self._report(messages.Failed(f"REST cannot be served: {error}"))
            await self._stopping.wait()
            return
        self._await_control()
        self._report(messages.Ready({"tls": self._settings.api_tls}))
        work: dict[str, Callable[[], Awaitable[object]]] = {
            "the journal of calls": partial(self._flush, gate),
            "the history of measurements": history.run,
        }
        if context is not None:
            work["the certificate of REST"] = partial(self._renew, context)
        running = [loop.create_task(run_always(what, one)) for what, one in work.items()]
        await self._stopping.wait()
        for task in running:
            task.cancel()
        await listener.stop()
        self._journal.flush()
        self._control.close()

    def _end(self) -> None:
        self._stopping.set()
        self._given.set()

    def _context(self) -> ssl.SSLContext:
        return tls_context(*self._certify())

    async def _renew(self, context: ssl.SSLContext) -> None:
        while True:
            await asyncio.sleep(_RENEW_SECONDS)
            try:
                if await asyncio.to_thread(renew, context, *self._certify()):
                    _log.warning("REST has a new certificate, of the same key")
                    self._state_served()
            except (OSError, ValueError) as error:
                _log.error("the certificate of REST cannot be renewed", reason=str(error))

    def _state_served(self) -> None:
        home = self._settings.state / "api"
        self._control.state_served(pin_of(home), fingerprint_of(home))

    def _certify(self) -> tuple[Path, list[str], datetime.datetime]:
        address = self._settings.api_address
        names = self._settings.rest_names
        if address is not None and address[0] not in ("0.0.0.0", "::"):  # noqa: S104  compared only
            names.append(address[0])
        return self._settings.state / "api", names, clock.utc_now()

    async def _flush(self, gate: RequestGate) -> None:
        while True:
            await asyncio.sleep(FOLD_SECONDS)
            self._journal.flush()
            self._control.state_running(gate.long_requests())

    def _await_control(self) -> None:
        if self._control.connected or self._without_control is not None:
            return
        loop = asyncio.get_running_loop()
        self._without_control = loop.call_later(_WITHOUT_CONTROL_SECONDS, self._give_up)

    def _give_up(self) -> None:
        self._without_control = None
        if not self._control.connected:
            _log.error("control was not connected for a long time: the api is restarted")
            self._stopping.set()

    def _token_used(self, token: str) -> None:
        self._control.token_used(token)

    def _report(self, message: messages.Message) -> None:
        try:
            self._lifeline.send(message)
        except ChannelClosedError:
            self._stopping.set()

    def _on_message(self, message: object, descriptors: tuple[int, ...]) -> None:
        match message:
            case messages.Ping(number):
                self._report(messages.Pong(number))
            case messages.Stop():
                self._end()
            case messages.ServicePaused(reason):
                self._control.paused = reason
            case messages.SocketRestored(name) if name == "api":
                self._socket = socket.socket(fileno=descriptors[0])
                self._given.set()
            case messages.LinkOpened(role) if role == "control":
                sock = socket.socket(fileno=descriptors[0])
                self._control.attach(Channel(sock, ApiLink, limit=8 << 20, longest=64 << 20))
            case _:
                for descriptor in descriptors:
                    os.close(descriptor)
                _log.error(
                    "the supervisor sent a message that is not for the api", message=type(message).__name__
                )
