"""Make the appliance's XML-RPC calls, with a time limit for each call and a size limit for each response."""

import asyncio
import socket
from collections import deque
from collections.abc import Callable
from typing import cast

import httptools

from appliance.rpc.fair_queue import weigh
from roswire.errors import PeerError
from roswire.uris import NodeUri, node_uri
from roswire.xmlrpc import FaultReceived, Value, XmlRpcLimits, build_call, parse_response


class CallFailedError(Exception):
    """A call has no usable answer; the message gives the reason and the address."""


class RefusedError(CallFailedError):
    """No server listens at the address."""


class NoRouteError(RefusedError):
    """The machine is off, or out of reach."""


class UnreachedError(CallFailedError):
    """No connection was made in time: the machine is off, or packets are lost."""


class UnansweredError(CallFailedError):
    """No answer came in time: the peer hangs or is very slow."""


class BrokenOffError(CallFailedError):
    """The connection broke; the peer may have carried out the call."""


class XmlRpcClient:
    """A client that keeps up to `pool` connections (0: a new one for each call).

    `timeout` is in seconds and applies to a whole call. `bare` leaves out the header fields that the ROS master does
    not need: each would cost it 10 µs.
    """

    def __init__(
        self,
        uri: NodeUri,
        *,
        timeout: float,
        pool: int = 0,
        bare: bool = False,
        limits: XmlRpcLimits | None = None,
        disconnected: Callable[[], None] | None = None,
    ) -> None:
        self.uri = uri
        self._disconnected = disconnected
        self._timeout = timeout
        self._pool = pool
        self._limits = limits or XmlRpcLimits()
        self._idle: deque[_Connection] = deque()
        host = f"[{uri.host}]" if ":" in uri.host else uri.host
        more = "" if bare else "User-Agent: rosrv\r\nContent-Type: text/xml\r\n"
        more += "" if pool else "Connection: close\r\n"
        head = f"POST {uri.path} HTTP/1.1\r\nHost: {host}:{uri.port}\r\n{more}Content-Length: "
        self.head = head.encode("ascii")

    async def call(self, method: str, *params: Value) -> Value:
        """Make a call. Raises `CallFailedError`, even if the peer is slow, silent or misbehaves."""
        body = await self._encode(method, params)
        request = b"%b%d\r\n\r\n%b" % (self.head, len(body), body)  # no format has a path of the peer
        seconds = self._timeout + len(request) // _READ_IN_A_SECOND
        try:
            response = await self._exchange(request, seconds)
        except TimeoutError:
            raise UnansweredError(f"{self._where} did not answer {method} within {seconds:g} s") from None
        except OSError as error:
            raise _kind(error)(f"{self._where} could not be called: {error.strerror or error}") from error
        try:
            if len(response) > _OFFLOAD:
                return await asyncio.to_thread(parse_response, response, self._limits)
            return parse_response(response, self._limits)
        except FaultReceived as fault:
            raise CallFailedError(f"{self._where} answered {method} with a fault: {fault}") from fault
        except PeerError as error:
            raise CallFailedError(f"{self._where} answered {method} with nonsense: {error}") from error

    async def reaches(self, seconds: float) -> bool:
        """Return whether the address takes a connection within this time."""
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(seconds):
                transport, _protocol = await loop.create_connection(
                    asyncio.Protocol, self.uri.host, self.uri.port
                )
        except OSError:  # also `TimeoutError`
            return False
        transport.close()
        return True

    async def _encode(self, method: str, params: tuple[Value, ...]) -> bytes:
        if weigh(list(params), _OFFLOAD) < _OFFLOAD:
            return build_call(method, params)
        return await asyncio.to_thread(build_call, method, params)

    @property
    def _where(self) -> str:
        return node_uri(self.uri.host, self.uri.port, self.uri.path)

    async def _exchange(self, request: bytes, seconds: float) -> bytes:
        """Return the response. Raises `UnreachedError` without a connection in time, or another `OSError`."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + seconds
        while self._idle:
            connection = self._idle.pop()
            if connection.alive:
                try:
                    return await self._request(connection, request, deadline)
                except ConnectionResetError:
                    if connection.answering:
                        raise
                    continue  # the server may close a kept connection at any time: use another connection
        try:
            async with asyncio.timeout_at(deadline):
                _transport, connection = await loop.create_connection(
                    lambda: _Connection(self._limits.body, self._disconnected), self.uri.host, self.uri.port
                )
        except TimeoutError:
            why = f"{self._where} cannot be reached: no connection within {seconds:g} s"
            raise UnreachedError(why) from None
        return await self._request(connection, request, deadline)

    async def _request(self, connection: "_Connection", request: bytes, deadline: float) -> bytes:
        kept = False
        late = asyncio.get_running_loop().call_at(deadline, connection.give_up)
        try:
            response = await connection.request(request)
            kept = connection.alive and len(self._idle) < self._pool
            return response
        finally:
            late.cancel()
            if kept:
                self._idle.append(connection)
            else:
                connection.close()

    def close(self) -> None:
        self._pool = 0
        while self._idle:
            self._idle.pop().close()


class _Connection(asyncio.Protocol):
    def __init__(self, body_limit: int, disconnected: Callable[[], None] | None) -> None:
        self._body_limit = body_limit
        self._disconnected = disconnected
        self._answer: asyncio.Future[bytes] | None = None
        self.alive = False
        self.answering = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.alive = True

    def request(self, data: bytes) -> "asyncio.Future[bytes]":
        self._answer = asyncio.get_running_loop().create_future()
        self._parser = httptools.HttpResponseParser(self)
        self._body = bytearray()
        self._received = 0
        self._until_end = True
        self.answering = False
        self._transport.write(data)
        return self._answer

    def give_up(self) -> None:
        self._fail(TimeoutError())

    def close(self) -> None:
        self.alive = False
        self._transport.abort()

    def data_received(self, data: bytes) -> None:
        self.answering = True
        if self._answer is None or self._answer.done():
            self.close()
            return
        self._received += len(data)
        if self._received > self._body_limit + _HEAD_LIMIT:
            self._fail(ConnectionError(f"the answer is larger than {self._body_limit} bytes"))
            return
        try:
            self._parser.feed_data(data)
        except (httptools.HttpParserError, httptools.HttpParserUpgrade) as error:
            self._fail(ConnectionError(f"not an HTTP response: {error}"))

    def connection_lost(self, _error: Exception | None) -> None:
        if self.alive and self._disconnected is not None:
            self._disconnected()
        self.alive = False
        if self._answer is not None and not self._answer.done():
            if self._body and self._until_end:
                self._answer.set_result(bytes(self._body))
            else:
                self._fail(ConnectionResetError("the connection was closed before the answer was whole"))

    # --- httptools callbacks ---

    def on_header(self, name: bytes, value: bytes) -> None:  # noqa: ARG002 - httptools' callback
        if name.lower() in (b"content-length", b"transfer-encoding"):
            self._until_end = False

    def on_body(self, piece: bytes) -> None:
        self._body += piece

    def on_message_complete(self) -> None:
        status = self._parser.get_status_code()
        if not self._parser.should_keep_alive():
            self.alive = False
        if self._answer is None or self._answer.done():
            return
        if status != 200:
            self._fail(ConnectionError(f"HTTP status {status}"))
        else:
            self._answer.set_result(bytes(self._body))

    def _fail(self, error: OSError) -> None:
        self.alive = False
        if self._answer is not None and not self._answer.done():
            self._answer.set_exception(error)
        self._transport.abort()


def _kind(error: OSError) -> type[CallFailedError]:
    if error.errno in _UNREACHABLE:
        return NoRouteError
    if isinstance(error, ConnectionRefusedError):
        return RefusedError
    return BrokenOffError if isinstance(error, ConnectionResetError | BrokenPipeError) else CallFailedError


_HEAD_LIMIT = 64 << 10
_READ_IN_A_SECOND = 1 << 20  # bytes that a slow machine parses in a second; larger values get more time
_OFFLOAD = 256 << 10  # the most bytes of a call or answer that the event loop encodes or parses itself
_UNREACHABLE = frozenset({101, 113})  # ENETUNREACH, EHOSTUNREACH
