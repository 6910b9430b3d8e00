"""HTTP for XML-RPC: requests off a listening socket, under limits, one at a time per connection.

httptools (llhttp) parses; this module bounds. Invariants:

1. Nothing is buffered beyond the limits: head 64 KiB within 10 s, body by `Limits.body`, one request in
   flight per connection (reading pauses meanwhile), one response in the write buffer.
2. A connection that makes no progress is closed by the sweep, whatever state it is in.
3. An address that no rule names is answered before its body is read.
4. Hosts are served in turn: when all slots are busy, the next slot goes to the host that waited longest since
   its last turn, so one host's flood costs the others one slot's time.
"""

import asyncio
import ipaddress
import socket
import time
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import cast

import httptools
import structlog

from appliance.policy.model import Address

_log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class HttpLimits:
    """Bounds of the HTTP layer; bytes and seconds."""

    head_bytes: int = 64 << 10
    head_seconds: float = 10.0
    body_bytes: int = 16 << 20
    stall_seconds: float = 30.0
    idle_seconds: float = 300.0
    connections_per_host: int = 512
    connections: int = 4096
    slots: int = 64


@dataclass(frozen=True, slots=True)
class Peer:
    """Who is connected: `host` and `text` are the peer's address, `local` the address he reached us at."""

    host: Address
    text: str
    local: str


@dataclass(frozen=True, slots=True)
class HttpRequest:
    """A whole POST: the path asked for, the body, and when its last byte arrived (monotonic ns)."""

    peer: Peer
    path: str
    body: bytes
    arrived: int


Handler = Callable[[HttpRequest], Awaitable[bytes]]


class Visitors:
    """All connections of every listener that shares it: counted per host, and swept of those that are stuck."""

    def __init__(self, limits: HttpLimits) -> None:
        self._limits = limits
        self.connections: set[_Connection] = set()
        self._per_host: dict[Address, int] = {}
        self._total = 0

    def enter(self, host: Address) -> str | None:
        """Count a connection in; a sentence instead when the host or the appliance has too many."""
        mine = self._per_host.get(host, 0)
        if mine >= self._limits.connections_per_host:
            return f"{host} has {mine} connections open, the limit for one host"
        if self._total >= self._limits.connections:
            return f"{self._total} connections are open, the limit for all hosts"
        self._per_host[host] = mine + 1
        self._total += 1
        return None

    def leave(self, host: Address) -> None:
        """Count a connection out."""
        self._total -= 1
        remaining = self._per_host[host] - 1
        if remaining:
            self._per_host[host] = remaining
        else:
            del self._per_host[host]

    async def sweep(self) -> None:
        """Every second, close the connections whose deadline has passed; runs until cancelled."""
        while True:
            await asyncio.sleep(1.0)
            now = time.monotonic()
            for connection in [one for one in self.connections if one.deadline < now]:
                connection.expire()


class Turns:
    """Slots for requests being served; when all are taken, hosts wait in turn."""

    def __init__(self, slots: int) -> None:
        self._free = slots
        self._waiting: OrderedDict[Address, deque[asyncio.Future[None]]] = OrderedDict()

    async def enter(self, host: Address) -> None:
        """Take a slot, waiting for this host's turn when there is none."""
        if self._free and not self._waiting:
            self._free -= 1
            return
        turn = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(host, deque()).append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():
                self.leave()
            raise

    def leave(self) -> None:
        """Give the slot to the next host in turn, or back."""
        while self._waiting:
            host, queue = self._waiting.popitem(last=False)
            turn = queue.popleft()
            if queue:
                self._waiting[host] = queue  # to the end of the line: its next request waits a round
            if not turn.done():
                turn.set_result(None)
                return
        self._free += 1


class HttpServer:
    """Serves one listening socket: each request goes to `handler`, whose bytes are the response body.

    `refuse(peer)` is asked when the head of a request is there: the bytes it returns are sent instead of reading
    the body, and the connection is closed. `troubled(peer, reason)` hears of every limit that was hit.
    """

    def __init__(
        self,
        sock: socket.socket,
        handler: Handler,
        *,
        limits: HttpLimits,
        visitors: Visitors,
        turns: Turns,
        refuse: Callable[[Peer], bytes | None] = lambda peer: None,  # noqa: ARG005 - names the parameter
        troubled: Callable[[Peer, str], None] = lambda peer, reason: None,  # noqa: ARG005 - same
    ) -> None:
        self.socket = sock
        self.handler = handler
        self.limits = limits
        self.visitors = visitors
        self.turns = turns
        self.refuse = refuse
        self.troubled = troubled
        self._server: asyncio.Server | None = None

    async def start(self) -> None:
        """Begin to accept."""
        loop = asyncio.get_running_loop()
        self.socket.setblocking(False)
        self._server = await loop.create_server(lambda: _Connection(self), sock=self.socket, backlog=1024)

    def close(self) -> None:
        """Stop accepting and cut what is connected; the listening socket is closed with it."""
        if self._server is not None:
            self._server.close()
        for connection in [one for one in self.visitors.connections if one.server is self]:
            connection.abort()


class _Connection(asyncio.Protocol):
    """One connection: feeds the parser, serves its requests one after the other."""

    def __init__(self, server: HttpServer) -> None:
        self.server = server
        self._limits = server.limits
        self.deadline = time.monotonic() + server.limits.head_seconds
        self._counted = False
        self._busy: asyncio.Task[None] | None = None
        self._pending: deque[tuple[HttpRequest, bool]] = deque()
        self._head_bytes = 0
        self._head_done = False
        self._closing = False

    # --- asyncio.Protocol ---

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport = cast(asyncio.Transport, transport)
        peername, sockname = transport.get_extra_info("peername"), transport.get_extra_info("sockname")
        if not peername:  # gone before it was accepted
            self._closing = True
            transport.abort()
            return
        host = plain_address(peername[0])
        self.peer = Peer(host, str(host), str(plain_address(sockname[0])))
        too_many = self.server.visitors.enter(host)
        if too_many is not None:
            self._closing = True
            self.server.troubled(self.peer, too_many)
            transport.abort()
            return
        self._counted = True
        self.server.visitors.connections.add(self)
        sock = transport.get_extra_info("socket")
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._parser = httptools.HttpRequestParser(self)

    def connection_lost(self, _error: Exception | None) -> None:
        self._closing = True
        if self._counted:
            self.server.visitors.leave(self.peer.host)
            self._counted = False
        self.server.visitors.connections.discard(self)
        self._pending.clear()

    def data_received(self, data: bytes) -> None:
        if self._closing:
            return
        try:
            self._parser.feed_data(data)
        except httptools.HttpParserUpgrade:
            self._reject(b"501 Not Implemented", "asked for another protocol")
        except httptools.HttpParserError as error:
            if not self._closing:
                self._reject(b"400 Bad Request", f"sent something that is not HTTP: {error}")
        if not self._head_done and not self._closing:
            self._head_bytes += len(data)
            if self._head_bytes > self._limits.head_bytes:
                self._reject(b"431 Request Header Fields Too Large", "sent a request head beyond the limit")
        elif self._head_done and self._busy is None:
            self.deadline = time.monotonic() + self._limits.stall_seconds

    # --- httptools callbacks ---

    def on_message_begin(self) -> None:
        self._url = b""
        self._body: list[bytes] = []
        self._size = 0
        self._head_bytes = 0
        self._head_done = False
        self._expects = False
        self._refused = False
        if self._busy is None:
            self.deadline = time.monotonic() + self._limits.head_seconds

    def on_url(self, url: bytes) -> None:
        self._url += url

    def on_header(self, name: bytes, value: bytes) -> None:
        lowered = name.lower()
        if lowered == b"content-length" and value.isdigit() and int(value) > self._limits.body_bytes:
            self._reject(
                b"413 Content Too Large",
                f"announced a body of {int(value)} bytes; the limit is {self._limits.body_bytes}",
            )
        elif lowered == b"expect" and value.lower() == b"100-continue":
            self._expects = True

    def on_headers_complete(self) -> None:
        self._head_done = True
        if self._closing:
            return
        if self._parser.get_method() != b"POST":
            self._reject(b"405 Method Not Allowed", "did not POST")
            return
        refusal = self.server.refuse(self.peer)
        if refusal is not None:
            self._closing = True
            self._write(b"200 OK", refusal, keep=False)
        elif self._expects:
            self._transport.write(b"HTTP/1.1 100 Continue\r\n\r\n")

    def on_body(self, piece: bytes) -> None:
        if self._closing:
            return
        self._size += len(piece)
        if self._size > self._limits.body_bytes:
            self._reject(b"413 Content Too Large", f"sent a body beyond {self._limits.body_bytes} bytes")
            return
        self._body.append(piece)

    def on_message_complete(self) -> None:
        if self._closing:
            return
        body = self._body[0] if len(self._body) == 1 else b"".join(self._body)
        self._body = []
        request = HttpRequest(self.peer, self._url.decode("latin-1"), body, time.monotonic_ns())
        self._pending.append((request, self._parser.should_keep_alive()))
        if self._busy is None:
            self._serve_next()
        else:
            self._transport.pause_reading()

    # --- serving ---

    def _serve_next(self) -> None:
        request, keep = self._pending.popleft()
        self.deadline = float("inf")  # the handler has limits of its own
        self._busy = asyncio.get_running_loop().create_task(self._serve(request, keep))

    async def _serve(self, request: HttpRequest, keep: bool) -> None:
        turns = self.server.turns
        await turns.enter(request.peer.host)
        status = b"200 OK"
        try:
            body = await self.server.handler(request)
        except Exception:  # noqa: BLE001 - a defect of ours must not leave the peer without an answer
            _log.exception("a request could not be served", host=request.peer.text, path=request.path[:200])
            status, body = b"500 Internal Server Error", b""
        finally:
            turns.leave()
            self._busy = None
        if self._closing:
            return
        self._write(status, body, keep=keep)
        self.deadline = time.monotonic() + self._limits.idle_seconds
        if keep and self._pending:
            self._serve_next()
        elif keep:
            self._transport.resume_reading()

    def _write(self, status: bytes, body: bytes, *, keep: bool) -> None:
        connection = b"keep-alive" if keep else b"close"
        head = b"HTTP/1.1 %b\r\nContent-Type: text/xml\r\nContent-Length: %d\r\nConnection: %b\r\n\r\n"
        self._transport.write(head % (status, len(body), connection) + body)
        if not keep:
            self._closing = True
            self.deadline = time.monotonic() + self._limits.stall_seconds
            self._transport.close()

    def _reject(self, status: bytes, what: str) -> None:
        self._closing = True
        self.server.troubled(self.peer, f"{self.peer.text} {what}")
        self._write(status, b"", keep=False)

    def expire(self) -> None:
        """Called by the sweep when the deadline passed."""
        if not self._head_done and self._head_bytes:
            self.server.troubled(self.peer, f"{self.peer.text} did not finish a request in time")
        self.abort()

    def abort(self) -> None:
        """Cut the connection now."""
        self._closing = True
        self._transport.abort()


def plain_address(text: str) -> Address:
    """The address without scope, an IPv4 address in IPv6 clothes as the IPv4 address it is."""
    address = ipaddress.ip_address(text.partition("%")[0])
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        return address.ipv4_mapped
    return address


def listen(host: str, port: int) -> socket.socket:
    """A TCP socket bound to `host:port` (port 0: one that is free), listening; `::` takes IPv4 as well."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_STREAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        sock.bind((host, port))
        sock.listen(1024)
    except OSError:
        sock.close()
        raise
    return sock
