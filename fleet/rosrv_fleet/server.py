"""Serve the collector over TLS. Robots present a client certificate, operators a token.

The trusted certificates are exactly those of the enrolled robots: no authority can certify another robot.
"""

import asyncio
import ssl
from typing import Any

import structlog
import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from rosrv_fleet.access import PEER_CERTIFICATE
from rosrv_fleet.app import make_app
from rosrv_fleet.collector import Collector
from rosrv_fleet.robots import EnrolmentError, Robot, Robots
from rosrv_fleet.rollouts.service import BundleService

_RELOAD_SECONDS = 1.0
_log = structlog.get_logger()


class ServerTls:
    """The TLS context of the server. Certificates of robots that are enrolled later are added to it."""

    def __init__(self, certificate: str, key: str, robots: Robots) -> None:
        """Load the server's certificate. Raises `ssl.SSLError` and `OSError`."""
        self.context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        self.context.minimum_version = ssl.TLSVersion.TLSv1_3
        self.context.load_cert_chain(certificate, key)
        self.context.verify_mode = ssl.CERT_OPTIONAL
        self.context.verify_flags |= (
            ssl.VERIFY_X509_PARTIAL_CHAIN
        )  # a robot's certificate is its own authority
        self._robots = robots
        self._trusted: set[str] = set()

    def reload(self) -> None:
        """Trust the robots that were enrolled since; a removed one is refused by each request."""
        for robot in self._robots.all().values():
            if robot.removed is None and robot.certificate not in self._trusted:
                self._trusted.add(robot.certificate)
                self._trust(robot)

    def _trust(self, robot: Robot) -> None:
        try:
            self.context.load_verify_locations(cadata=robot.certificate)
        except ssl.SSLError as error:
            _log.error("a certificate cannot be trusted", robot=robot.name, reason=str(error))


def _protocol(header_seconds: float) -> type[HttpToolsProtocol]:
    """Return the protocol that passes on the client's certificate, and ends connections without a request."""

    class Connection(HttpToolsProtocol):
        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # asyncio's own type
            super().connection_made(transport)
            tls = transport.get_extra_info("ssl_object")
            certificate = None if tls is None else tls.getpeercert(binary_form=True)
            self.app_state = {**self.app_state, PEER_CERTIFICATE: certificate}
            self._wait_for_headers()

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

    return Connection


class _Server(uvicorn.Server):
    """The server, which also watches for enrolled robots, and ends the robots' event streams when it stops."""

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

    async def _watch(self) -> None:
        while True:
            try:
                self._tls.reload()
            except (EnrolmentError, OSError) as error:
                _log.error("the robots cannot be read", reason=str(error))
            await asyncio.sleep(_RELOAD_SECONDS)


def serve(collector: Collector) -> None:
    """Serve until a signal ends the process. Raises `OSError` and `ssl.SSLError`."""
    config = collector.config
    tls = ServerTls(str(config.certificate), str(config.key), collector.robots)
    tls.reload()
    host, port = config.address
    options: dict[str, Any] = {"log_config": None, "access_log": False, "server_header": False}
    settings = uvicorn.Config(
        make_app(collector),
        host=host,
        port=port,
        http=_protocol(config.limits.header_seconds),
        ws="none",
        limit_concurrency=config.limits.connections,
        timeout_keep_alive=30,
        timeout_graceful_shutdown=20,
        h11_max_incomplete_event_size=65_536,
        ssl_context_factory=lambda _config, _default: tls.context,
        **options,
    )
    _Server(settings, tls, collector.bundles).run()
