"""Connect to the provider. Nothing that it sends is trusted before it is checked.

1. Every connection goes to `Sso.destination`, whatever host a URL has. The firewall permits nothing else.
2. TLS verifies the host of the URL. Without a proxy, all URLs have the issuer's origin.
3. An exchange has one deadline and a limit of bytes, and follows no redirect. Compressed answers are rejected.
"""

import asyncio
import ssl
from collections.abc import Awaitable, Callable, Iterable, Sequence
from typing import NamedTuple

import httpcore

from appliance.base.input_files import path_for_library
from appliance.features.sso.errors import ProviderError
from appliance.features.sso.settings import Sso, origin_of

EXCHANGE_SECONDS = 10.0
LARGEST_ANSWER = 262_144
_FAILURES = (
    httpcore.TimeoutException,
    httpcore.NetworkError,
    httpcore.ProtocolError,
    httpcore.ProxyError,
    OSError,
)

Headers = Sequence[tuple[str, str]]
Pool = httpcore.AsyncConnectionPool | httpcore.AsyncHTTPProxy


class ProviderAnswer(NamedTuple):
    status: int
    body: bytes


Exchange = Callable[[str, str, Headers, bytes], Awaitable[ProviderAnswer]]
"""Sends a request (method, URL, headers, body). Raises `ProviderError`."""


class ProviderConnection:
    """Sends requests to the provider, each on its own connection."""

    def __init__(self, wanted: Sso) -> None:
        self._wanted = wanted
        self._only = origin_of(wanted.issuer or "") if wanted.proxy is None else None

    async def exchange(
        self, method: str, url: str, headers: Headers = (), body: bytes = b""
    ) -> ProviderAnswer:
        try:
            origin = origin_of(url)
        except ValueError as error:
            raise ProviderError(f"the provider names an address that cannot be used: {error}") from None
        if self._only is not None and origin != self._only:
            raise ProviderError(
                f"{url}: this is not the issuer's host; set sso.proxy to reach more than one host"
            )
        sent = [("Accept", "application/json"), ("Accept-Encoding", "identity"), *headers]
        try:
            async with (
                asyncio.timeout(EXCHANGE_SECONDS),
                self._pool() as pool,
                pool.stream(method, url, headers=sent, content=body) as answer,
            ):
                return ProviderAnswer(answer.status, await _read_bounded(url, answer))
        except TimeoutError:
            raise ProviderError(f"{url}: no complete answer within {EXCHANGE_SECONDS:g} s") from None
        except _FAILURES as error:
            raise ProviderError(
                f"{url}: {str(error) or 'the connection ended'}{self._advice(error)}"
            ) from error

    def _pool(self) -> Pool:
        context = _tls(self._wanted)
        network = _OneDestination(*self._wanted.destination)
        if self._wanted.proxy is not None:
            return httpcore.AsyncHTTPProxy(self._wanted.proxy, ssl_context=context, network_backend=network)
        return httpcore.AsyncConnectionPool(ssl_context=context, network_backend=network)

    def _advice(self, error: Exception) -> str:
        if isinstance(error.__cause__, ssl.SSLCertVerificationError) and self._wanted.ca is None:
            return "; name the authority of its certificate in sso.ca"
        return ""


class _OneDestination(httpcore.AsyncNetworkBackend):
    def __init__(self, address: str, port: int) -> None:
        self._address, self._port = address, port
        self._network = httpcore.AnyIOBackend()

    async def connect_tcp(
        self,
        host: str,  # noqa: ARG002  only the address counts
        port: int,  # noqa: ARG002  as above
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[httpcore.SOCKET_OPTION] | None = None,
    ) -> httpcore.AsyncNetworkStream:
        return await self._network.connect_tcp(
            self._address, self._port, timeout, local_address, socket_options
        )


def _tls(wanted: Sso) -> ssl.SSLContext:
    """Make a context for each exchange, so that replaced files apply."""
    if wanted.ca is None:
        context = ssl.create_default_context()
    else:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        try:
            with path_for_library(wanted.ca) as authority:
                context.load_verify_locations(authority)
        except OSError as error:
            raise OSError(
                error.errno, f"cannot be used: {error.strerror or error}", str(wanted.ca)
            ) from error
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    return context


async def _read_bounded(url: str, answer: httpcore.Response) -> bytes:
    for name, value in answer.headers:
        if name.lower() == b"content-encoding" and value.lower() != b"identity":
            raise ProviderError(
                f"{url}: the provider compresses its answer, which was not requested: switch compression off for the"
                " appliance"
            )
    body = bytearray()
    async for part in answer.aiter_stream():
        body += part
        if len(body) > LARGEST_ANSWER:
            raise ProviderError(
                f"{url}: the answer has more than {LARGEST_ANSWER} bytes: check that sso.issuer is the provider's"
                " address"
            )
    return bytes(body)
