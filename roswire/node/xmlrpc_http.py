"""XML-RPC over HTTP on a node's connections: calls as a client, and a server for the node API.

Every wait has a time limit, and every request and answer a size limit.
"""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable

import httptools

from roswire.errors import LimitExceededError, PeerError, ProtocolError, RosError
from roswire.node.network import ByteWriter, NodeNetwork, PeerUnreachableError
from roswire.uris import NodeUri, node_uri
from roswire.xmlrpc import (
    DEFAULT_LIMITS,
    FaultReceived,
    MethodCall,
    Value,
    XmlRpcLimits,
    build_call,
    build_fault,
    build_response,
    parse_call,
    parse_response,
)

CALL_LIMITS = XmlRpcLimits(body=1 << 20, elements=20_000, depth=8, string=1 << 16, parts=1)
"""The limits of a node's answer. The longest answers list the node's topics."""
SERVED_LIMITS = XmlRpcLimits(parts=1)
"""The limits of a call to a node. The longest calls contain the value of a parameter."""

_HEAD_BYTES = 16 << 10
_IDLE_SECONDS = 120.0
_PIECE = 1 << 16


async def call_xmlrpc(
    network: NodeNetwork,
    uri: NodeUri,
    method: str,
    params: tuple[Value, ...],
    *,
    seconds: float,
    limits: XmlRpcLimits = DEFAULT_LIMITS,
) -> Value:
    """Return the result of a call. Raise `PeerUnreachableError`, or another `RosError` if the answer is unusable."""
    where = node_uri(uri.host, uri.port, uri.path)
    host = f"[{uri.host}]" if ":" in uri.host else uri.host
    body = build_call(method, params)
    head = (
        f"POST {uri.path} HTTP/1.1\r\nHost: {host}:{uri.port}\r\nContent-Type: text/xml\r\n"
        f"Connection: close\r\nContent-Length: {len(body)}\r\n\r\n"
    )
    try:
        async with asyncio.timeout(seconds):
            reader, writer = await network.connect(uri.host, uri.port)
            try:
                writer.write(head.encode("ascii") + body)
                status, answer = await _read_answer(reader, limits.body)
            finally:
                writer.close()
        return _value(status, answer, limits)
    except TimeoutError:
        raise PeerUnreachableError(f"{where} did not answer {method} within {seconds:g} s") from None
    except OSError as error:
        raise PeerUnreachableError(f"{where} cannot be called: {error.strerror or error}") from error
    except FaultReceived as fault:
        raise ProtocolError(f"{where} answered {method} with a fault: {fault.text[:300]}") from fault
    except PeerError as error:
        raise ProtocolError(f"{where} gave no valid answer to {method}: {error}") from error


class _Message:
    def __init__(self) -> None:
        self.bodies: deque[bytes] = deque()
        self._body = bytearray()

    def on_body(self, piece: bytes) -> None:
        self._body += piece

    def on_message_complete(self) -> None:
        self.bodies.append(bytes(self._body))
        self._body = bytearray()

    def rest(self) -> bytes:
        return bytes(self._body)


def _value(status: int, answer: bytes, limits: XmlRpcLimits) -> Value:
    """Return the value of an answer. With a status other than 200, its reason may still be a fault."""
    try:
        value = parse_response(answer, limits)
    except FaultReceived:
        raise
    except PeerError:
        if status == 200:
            raise
    if status != 200:
        raise ProtocolError(f"HTTP status {status}")
    return value


async def _read_answer(reader: asyncio.StreamReader, most: int) -> tuple[int, bytes]:
    message = _Message()
    parser = httptools.HttpResponseParser(message)
    received = 0
    while not message.bodies:
        data = await reader.read(_PIECE)
        if not data:  # without a length, the body ends with the connection
            if message.rest():
                return parser.get_status_code(), message.rest()
            raise ConnectionResetError("the connection ended before the answer was complete")
        received += len(data)
        if received > most + _HEAD_BYTES:
            raise LimitExceededError(f"the answer is larger than {most} bytes")
        _feed(parser, data)
    return parser.get_status_code(), message.bodies.popleft()


def _feed(parser: "httptools.HttpResponseParser | httptools.HttpRequestParser", data: bytes) -> None:
    try:
        parser.feed_data(data)
    except (httptools.HttpParserError, httptools.HttpParserUpgrade) as error:
        raise ProtocolError(f"not HTTP: {error}") from None


async def serve_xmlrpc(
    reader: asyncio.StreamReader, writer: ByteWriter, answer: Callable[[MethodCall], Awaitable[Value]]
) -> None:
    """Answer calls in order until the peer ends the connection, is idle, or breaks the protocol."""
    message = _Message()
    parser = httptools.HttpRequestParser(message)
    received = 0  # bytes since the last complete request
    try:
        while True:
            async with asyncio.timeout(_IDLE_SECONDS):
                data = await reader.read(_PIECE)
            received += len(data)
            if not data or received > SERVED_LIMITS.body + _HEAD_BYTES:
                return
            _feed(parser, data)
            while message.bodies:
                received = 0
                writer.write(_http_answer(await _answer(message.bodies.popleft(), answer)))
                async with asyncio.timeout(_IDLE_SECONDS):
                    await writer.drain()
                if not parser.should_keep_alive():
                    return
    except (OSError, ProtocolError):  # a time limit is an OSError; the peer is served no further
        return
    finally:
        writer.close()


async def _answer(body: bytes, answer: Callable[[MethodCall], Awaitable[Value]]) -> bytes:
    try:
        return build_response(await answer(parse_call(body, SERVED_LIMITS)))
    except RosError as error:
        return build_fault(-1, str(error))


def _http_answer(body: bytes) -> bytes:
    head = f"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: {len(body)}\r\n\r\n"
    return head.encode("ascii") + body
