"""Serve the collector over TLS. Robots present a client certificate, operators a token.

The trusted certificates are exactly those of the enrolled robots, so no authority can certify another robot.
"""

import asyncio
import hashlib
import socket
import ssl
from collections.abc import Callable
from pathlib import Path
from typing import Any

import structlog
import uvicorn
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding
from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from appliance.base.atomic_files import write_whole
from appliance.base.head_requests import AnswersHead
from appliance.base.log_output import keep_from_blocking
from appliance.signing.own_certificate import make_own_certificate
from rosrv_fleet.access import PEER_CERTIFICATE, certificate_of, token_of
from rosrv_fleet.app import make_app
from rosrv_fleet.collector import Collector
from rosrv_fleet.config import FleetConfig
from rosrv_fleet.connections import ClientConnections, listen, owner_of
from rosrv_fleet.enrolment import RobotAppliance
from rosrv_fleet.failures import failure_of
from rosrv_fleet.host_names import WRONG_HOST, CollectorNames
from rosrv_fleet.robots import Robots
from rosrv_fleet.rollouts.service import BundleService
from rosrv_fleet.tokens import OperatorTokens

# Make the collector's certificate, and read from it the address and the authority that invitations contain.

_DAYS = 3650  # every robot pins it, and must join again after a change


class ServerCertificateError(Exception):
    """The collector's certificate is missing or unusable for robots. The message has the remedy."""


def make_certificate(config: FleetConfig, address: str | None) -> bool:
    """Make a key and a certificate, or return False if there is one. Raise `ServerCertificateError` or `OSError`."""
    if config.certificate.exists():
        named = _addresses(config.certificate)
        if address is not None and address not in named:
            raise ServerCertificateError(
                f"{config.certificate} names {', '.join(named) or 'no address'}: to replace it, remove it and its key,"
                " repeat this, restart the collector, and let every robot join again"
            )
        return False
    try:
        key, certificate = make_own_certificate("rosrv-fleet", _DAYS, address or "")
    except ValueError:
        raise ServerCertificateError(
            f"{config.certificate} does not exist: give --address, an address at which robots reach this machine"
        ) from None
    write_whole(config.key, key, 0o600)
    write_whole(config.certificate, certificate, 0o644)
    return True


def authority_of(certificate: Path) -> str:
    """Return the last certificate of the file as PEM. Raise `ServerCertificateError` unless it is self-signed."""
    last = x509.load_pem_x509_certificates(certificate.read_bytes())[-1]
    if last.issuer != last.subject:
        raise ServerCertificateError(
            f"{certificate} does not end with its authority's certificate, which robots need: append it"
        )
    return last.public_bytes(Encoding.PEM).decode("ascii")


def url_of(config: FleetConfig) -> str:
    """Return the URL with the certificate's first address, or raise `ServerCertificateError` if it names none."""
    addresses = _addresses(config.certificate)
    if not addresses:
        raise ServerCertificateError(
            f"{config.certificate} names no IP address in its subjectAltName: make another one"
        )
    shown = f"[{addresses[0]}]" if ":" in addresses[0] else addresses[0]
    return f"https://{shown}:{config.address[1]}"


def names_of(certificate: Path) -> list[str]:
    """Return the host names in the certificate; one may begin with `*.`."""
    names = _alternative_names(certificate)
    return [] if names is None else names.get_values_for_type(x509.DNSName)


def _addresses(certificate: Path) -> list[str]:
    names = _alternative_names(certificate)
    return [] if names is None else [str(address) for address in names.get_values_for_type(x509.IPAddress)]


def _alternative_names(certificate: Path) -> x509.SubjectAlternativeName | None:
    first = x509.load_pem_x509_certificates(certificate.read_bytes())[0]
    try:
        return first.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return None


# Limit the requests of clients that are neither robots nor operators, by address, and check the name in them.
#
# The limit is checked before any route, so logins, wrong tokens and health checks count as well. Robots prove who they
# are by a certificate, which no browser sends, so they may use any name.


class Door:
    """An ASGI application that passes on the requests within the limits of `ClientConnections` to a name of its own."""

    def __init__(
        self,
        app: ASGIApp,
        table: ClientConnections,
        tokens: OperatorTokens,
        names: CollectorNames,
        robot: Callable[[bytes | None], str | None],
    ) -> None:
        """`robot` returns the robot of a certificate, at each request: a robot may be removed while it is connected."""
        self._app, self._table, self._tokens, self._names, self._robot = app, table, tokens, names, robot

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer 429 above the limit, and 421 to another name. The address of a request with a valid token counts as
        proven.
        """
        if scope["type"] == "http" and self._robot(certificate_of(request := Request(scope))) is None:
            owner = owner_of(request.client.host if request.client else "127.0.0.1")
            token, proven = token_of(request), self._table.is_proven(owner)
            # Verifying a token costs as much as an answer, so an unproven address pays for it first.
            paid = not proven and self._table.may_ask(owner)
            operator = bool(token) and (proven or paid) and self._is_held(token)
            if operator:
                self._table.prove(owner)
            elif not (paid or (proven and self._table.may_ask(owner))):
                reason = {
                    "detail": "this address sends too many requests without a valid token or certificate"
                }
                await JSONResponse(reason, 429, {"Retry-After": "1"})(scope, receive, send)
                return
            if not self._names.include(request.headers.getlist("host")):
                await JSONResponse({"detail": WRONG_HOST}, 421)(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _is_held(self, token: str) -> bool:
        """Return False if the tokens are unreadable: the route then reports the error."""
        try:
            return self._tokens.holder(token) is not None
        except OSError:
            return False


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

    def reload(self) -> None:
        """Trust new robots. A removed robot stays trusted by TLS, but each of its requests is rejected."""
        for robot in self._robots.known().values():
            for appliance in robot.connecting.values():
                if appliance.certificate not in self._trusted:
                    self._trusted.add(appliance.certificate)
                    self._trust(robot.name, appliance)

    def owner(self, certificate: bytes | None) -> str | None:
        """Return the fingerprint of a certificate of a robot that may connect now, or None."""
        if certificate is None:
            return None
        try:
            known = self._robots.with_certificate(certificate) is not None
        except OSError:  # the routes report it
            return None
        return hashlib.sha256(certificate).hexdigest() if known else None

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
            self.app_state = {**self.app_state, PEER_CERTIFICATE: certificate}
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
        AnswersHead(
            Door(
                make_app(collector),
                table,
                collector.tokens,
                CollectorNames([*config.names, *names_of(config.certificate)]),
                tls.owner,
            )
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
