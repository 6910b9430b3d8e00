"""Serve the collector over TLS. Robots present a client certificate, operators a token.

The trusted certificates are exactly those of the enrolled robots, so no authority can certify another robot.
"""

import asyncio
import hashlib
import socket
import ssl
from typing import Any

import structlog
import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from appliance.base.log_output import keep_from_blocking
from rosrv_fleet.access import IS_ROBOT, PEER_CERTIFICATE
from rosrv_fleet.app import make_app
from rosrv_fleet.collector import Collector
from rosrv_fleet.connections import ClientConnections, listen
from rosrv_fleet.door import Door
from rosrv_fleet.enrolment import RobotAppliance
from rosrv_fleet.failures import failure_of
from rosrv_fleet.host_names import CollectorNames
from rosrv_fleet.robots import Robots
from rosrv_fleet.rollouts.service import BundleService
from rosrv_fleet.server_certificate import names_of

_RELOAD_SECONDS = 1.0
_CLOSE_SECONDS = 1.0
_log = structlog.get_logger()


class ServerTls:
    """The TLS context of the server, to which certificates of new robots are added."""

    def __init__(self, certificate: str, key: str, robots: Robots) -> None:
        self.context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        self.context.minimum_version = ssl.TLSVersion.TLSv1_3
        self.context.load_cert_chain(certificate, key)
        self.context.verify_mode = ssl.CERT_OPTIONAL
        self.context.verify_flags |= (
            ssl.VERIFY_X509_PARTIAL_CHAIN
        )  # a robot's certificate is its own authority
        self._robots = robots
        self._trusted: set[str] = set()
        self._fingerprints: set[str] = set()

    def reload(self) -> None:
        """Trust new robots. A removed robot stays trusted by TLS, but each of its requests is rejected."""
        for robot in self._robots.known().values():
            for appliance in robot.connecting.values():
                if appliance.certificate not in self._trusted:
                    self._trusted.add(appliance.certificate)
                    self._fingerprints.add(appliance.fingerprint)
                    self._trust(robot.name, appliance)

    def owner(self, certificate: bytes | None) -> str | None:
        found = None if certificate is None else hashlib.sha256(certificate).hexdigest()
        return found if found in self._fingerprints else None

    def _trust(self, robot: str, appliance: RobotAppliance) -> None:
        try:
            self.context.load_verify_locations(cadata=appliance.certificate)
        except ssl.SSLError as error:
            _log.error("a certificate cannot be trusted", robot=robot, reason=str(error))


def _protocol(header_seconds: float, table: ClientConnections, tls: ServerTls) -> type[HttpToolsProtocol]:
    class _Connection(HttpToolsProtocol):
        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # asyncio's own type
            super().connection_made(transport)
            secured = transport.get_extra_info("ssl_object")
            certificate = None if secured is None else secured.getpeercert(binary_form=True)
            robot = tls.owner(certificate)
            self.app_state = {**self.app_state, PEER_CERTIFICATE: certificate, IS_ROBOT: robot is not None}
            self._wait_for_headers()
            number = transport.get_extra_info("socket").fileno()
            if number < 0 or not table.established(number, robot):
                transport.abort()

        def _wait_for_headers(self) -> None:
            self._headers_due = self.loop.call_later(header_seconds, self.transport.close)

        def on_message_begin(self) -> None:
            super().on_message_begin()
            self._headers_due.cancel()
            self._wait_for_headers()

        def on_headers_complete(self) -> None:
            self._headers_due.cancel()
            super().on_headers_complete()

        def connection_lost(self, exc: Exception | None) -> None:
            self._headers_due.cancel()
            super().connection_lost(exc)

    return _Connection


class _Server(uvicorn.Server):
    """A server that also trusts new robots, and ends the robots' event streams when it stops."""

    def __init__(self, config: uvicorn.Config, tls: ServerTls, bundles: BundleService | None) -> None:
        super().__init__(config)
        self._tls = tls
        self._bundles = bundles

    async def main_loop(self) -> None:
        watching = asyncio.create_task(self._watch())
        try:
            await super().main_loop()
        finally:
            watching.cancel()
            if self._bundles is not None:
                self._bundles.end_streams()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        ending = asyncio.create_task(self._end_idle())
        try:
            await super().shutdown(sockets)
        finally:
            ending.cancel()

    async def _end_idle(self) -> None:
        """Cut idle connections, because an idle client does not answer the end of TLS."""
        while True:
            await asyncio.sleep(_CLOSE_SECONDS)
            for connection in list(self.server_state.connections):
                assert isinstance(connection, HttpToolsProtocol)  # noqa: S101  for mypy: there are no others
                if connection.cycle is None or connection.cycle.response_complete:
                    connection.transport.abort()

    async def _watch(self) -> None:
        while True:
            try:
                self._tls.reload()
            except Exception as error:  # noqa: BLE001  after any failure, it reads them again
                _log.error("new robots are not trusted yet", reason=failure_of(error))
            await asyncio.sleep(_RELOAD_SECONDS)


def serve(collector: Collector) -> None:
    keep_from_blocking(2)
    config = collector.config
    tls = ServerTls(str(config.certificate), str(config.key), collector.robots)
    tls.reload()
    table = ClientConnections(config.limits)
    listener = listen(*config.address, table)
    options: dict[str, Any] = {"log_config": None, "access_log": False, "server_header": False}
    settings = uvicorn.Config(
        Door(
            make_app(collector),
            table,
            collector.tokens,
            CollectorNames([*config.names, *names_of(config.certificate)]),
        ),
        loop="asyncio",  # the connections are counted by its sockets
        http=_protocol(config.limits.header_seconds, table, tls),
        ws="none",
        timeout_keep_alive=90,  # robots report every 30 s and push every minute: without new handshakes
        timeout_graceful_shutdown=20,
        h11_max_incomplete_event_size=65_536,
        ssl_context_factory=lambda _config, _default: tls.context,
        **options,
    )
    _Server(settings, tls, collector.bundles).run([listener])
