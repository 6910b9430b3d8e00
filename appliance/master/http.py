"""HTTP for XML-RPC: requests off a listening socket, under limits, one at a time per connection.

httptools (llhttp) parses; this module bounds. Invariants:

1. Nothing is buffered beyond the limits: head 64 KiB within 10 s, body by `Limits.body`, one request in
   flight per connection (reading pauses meanwhile; those that came with it in one piece wait), one response in the
   write buffer (the next request is not served before it is sent). What all connections of a host hold together is
   bounded, too: bodies, requests that wait, answers.
2. A connection that makes no progress is closed by the sweep, whatever state it is in.
3. An address that no rule names is answered before its body is read.
4. Hosts are served in turn (`turns`): one host has at most `slots_per_host` requests being served.
5. Who is gone before it was his turn is not served: a request waits only as long as its connection lives.
6. Who goes over a limit is told so, in a fault that says which; of connections that are too many, a few at a time.
"""

import asyncio
import ipaddress
import socket
import time
from collections import Counter, deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import cast

import httptools
import structlog

from appliance.master.turns import Turns
from appliance.policy.model import Address
from appliance.ros.xmlrpc import build_fault

_log = structlog.get_logger()

# A head of many short fields is as long as the bytes it came in.
_FIELD_FRAMING = len(": \r\n")
# About what a request takes beside its body and its path: small ones may come by the thousand.
_REQUEST_BYTES = 400


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
    slots_per_host: int = 16
    held_bytes_per_host: int = 64 << 20
    held_bytes: int = 512 << 20
    linger_seconds: float = 2.0
    turned_away_per_host: int = 8  # connections that are too many and are being told so
    turned_away: int = 256

    @property
    def framing_bytes(self) -> int:
        """What a request may have beside its body: the head, chunk sizes, trailers."""
        return self.head_bytes + self.body_bytes // 16


@dataclass(frozen=True, slots=True)
class Peer:
    """Who is connected: `host` and `text` are the peer's address, `local` the address he reached us at."""

    host: Address
    text: str
    local: str

    @property
    def here(self) -> bool:
        """Whether the peer is on this machine."""
        return self.host.is_loopback or self.text == self.local


@dataclass(frozen=True, slots=True)
class HttpRequest:
    """A whole POST: the path asked for, the body, and when its last byte arrived (monotonic ns)."""

    peer: Peer
    path: str
    body: bytes
    arrived: int


Handler = Callable[[HttpRequest], Awaitable[bytes]]


class Visitors:
    """All connections of every listener that shares it, and the bytes they hold (bodies that are not answered yet,
    answers that are not taken yet): counted per host, and swept of those that are stuck.
    """

    def __init__(self, limits: HttpLimits) -> None:
        self._limits = limits
        self.connections: set[_Connection] = set()
        self._per_host: dict[Address, int] = {}
        self._total = 0
        self._turned_away: Counter[Address] = Counter()
        self._held: Counter[Address] = Counter()
        self._held_in_all = 0

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

    def turn_away(self, host: Address) -> bool:
        """Whether a connection that is too many may stay until it was told so; it is counted then."""
        if (
            self._turned_away[host] >= self._limits.turned_away_per_host
            or self._turned_away.total() >= self._limits.turned_away
        ):
            return False
        self._turned_away[host] += 1
        return True

    def turned_away(self, host: Address) -> None:
        """Such a connection is gone."""
        self._turned_away[host] -= 1
        if not self._turned_away[host]:
            del self._turned_away[host]

    def hold(self, host: Address, size: int) -> str | None:
        """Count bytes in that are kept for a host; a sentence instead (nothing is counted) when it is too much."""
        if self._held[host] + size > self._limits.held_bytes_per_host:
            return f"{host} has {self._held[host]} bytes in requests and answers under way, the limit for one host"
        if self._held_in_all + size > self._limits.held_bytes:
            return f"{self._held_in_all} bytes of requests and answers are under way, the limit for all hosts"
        self._held[host] += size
        self._held_in_all += size
        return None

    def release(self, host: Address, size: int) -> None:
        """Count bytes out."""
        self._held_in_all -= size
        self._held[host] -= size
        if not self._held[host]:
            del self._held[host]

    async def sweep(self) -> None:
        """Every second, close the connections whose deadline has passed; runs until cancelled."""
        while True:
            await asyncio.sleep(1.0)
            now = time.monotonic()
            for connection in [one for one in self.connections if one.deadline < now]:
                connection.expire()


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
        self._turned_away = False
        self._busy: asyncio.Task[None] | None = None
        self._waiting = False  # for its turn
        self._pending: deque[tuple[HttpRequest, bool]] = deque()
        self._received = 0  # bytes of the request that is being read, framing included
        self._body = bytearray()
        self._in_request = False
        self._head_done = False
        self._unsent = 0  # bytes of an answer that the peer does not take, as they were counted
        self._writable = True
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
            self._turn_away(too_many)
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
            self._release(len(self._body) + self._unsent + sum(_held_by(one) for one, _ in self._pending))
            self._body, self._unsent = bytearray(), 0
        if self._turned_away:
            self.server.visitors.turned_away(self.peer.host)
            self._turned_away = False
        self.server.visitors.connections.discard(self)
        self._pending.clear()
        if self._busy is not None and self._waiting:
            self._busy.cancel()

    def data_received(self, data: bytes) -> None:
        if not self._closing:
            self._feed(data)
        if not self._closing:
            self._bound(len(data))

    def _feed(self, data: bytes) -> None:
        try:
            self._parser.feed_data(data)
        except httptools.HttpParserUpgrade:
            pass  # refused when its head was complete
        except httptools.HttpParserError as error:
            if not self._closing:
                self._reject(b"400 Bad Request", f"sent something that is not HTTP: {error}")

    def _bound(self, size: int) -> None:
        if not self._in_request:
            return
        self._received += size
        if not self._head_done:
            if self._received > self._limits.head_bytes:
                self._reject(b"431 Request Header Fields Too Large", "sent a request head beyond the limit")
        elif self._received - len(self._body) > self._limits.framing_bytes:
            self._reject(b"400 Bad Request", "sent more chunk sizes and trailers than a request may have")
        elif self._busy is None and self._writable:
            self.deadline = time.monotonic() + self._limits.stall_seconds

    def pause_writing(self) -> None:
        self._writable = False
        self.deadline = time.monotonic() + self._limits.stall_seconds

    def resume_writing(self) -> None:
        self._writable = True
        self._release(self._unsent)
        self._unsent = 0
        if not self._closing and self._busy is None:
            self._go_on()

    # --- httptools callbacks ---

    def on_message_begin(self) -> None:
        self._url = b""
        self._received = 0
        self._head_bytes = 0
        self._in_request = True
        self._head_done = False
        self._expects = False
        if self._busy is None and self._writable:
            self.deadline = time.monotonic() + self._limits.head_seconds

    def on_url(self, url: bytes) -> None:
        self._url += url
        self._count_head(len(url))

    def on_header(self, name: bytes, value: bytes) -> None:
        self._count_head(len(name) + len(value) + _FIELD_FRAMING)
        if self._closing:
            return
        lowered = name.lower()
        if lowered == b"content-length" and value.isdigit() and int(value) > self._limits.body_bytes:
            self._reject(
                b"413 Content Too Large",
                f"announced a body of {int(value)} bytes; the limit is {self._limits.body_bytes}",
            )
        elif lowered == b"expect" and value.lower() == b"100-continue":
            self._expects = True

    def _count_head(self, size: int) -> None:
        self._head_bytes += size
        if self._head_bytes > self._limits.head_bytes and not self._closing:
            self._reject(b"431 Request Header Fields Too Large", "sent a request head beyond the limit")

    def on_headers_complete(self) -> None:
        self._head_done = True
        if self._closing:
            return
        if self._parser.get_method() != b"POST":
            self._reject(b"405 Method Not Allowed", "did not POST")
            return
        if self._parser.should_upgrade():
            self._reject(b"501 Not Implemented", "asked for another protocol")
            return
        refusal = self.server.refuse(self.peer)
        if refusal is not None:
            self._write(b"200 OK", refusal, keep=False, unread=True)
        elif self._expects:
            self._transport.write(b"HTTP/1.1 100 Continue\r\n\r\n")

    def on_body(self, piece: bytes) -> None:
        if self._closing:
            return
        if len(self._body) + len(piece) > self._limits.body_bytes:
            self._reject(b"413 Content Too Large", f"sent a body beyond {self._limits.body_bytes} bytes")
            return
        too_much = self.server.visitors.hold(self.peer.host, len(piece))
        if too_much is not None:
            self._reject(b"503 Service Unavailable", f"sent a body while {too_much}")
            return
        self._body += piece

    def on_message_complete(self) -> None:
        if self._closing:
            return
        too_much = self.server.visitors.hold(self.peer.host, _REQUEST_BYTES + len(self._url))
        if too_much is not None:
            self._reject(b"503 Service Unavailable", f"sent a request while {too_much}")
            return
        self._in_request = False
        body, self._body = bytes(self._body), bytearray()
        request = HttpRequest(self.peer, self._url.decode("latin-1"), body, time.monotonic_ns())
        self._pending.append((request, self._parser.should_keep_alive()))
        if self._busy is None and self._writable:
            self._serve_next()
        else:
            self._transport.pause_reading()

    # --- serving ---

    def _go_on(self) -> None:
        """The answer is sent: the next request, if it is there, or wait for one."""
        self.deadline = time.monotonic() + self._limits.idle_seconds
        if self._pending:
            self._serve_next()
        elif not self._transport.is_closing():
            self._transport.resume_reading()

    def _serve_next(self) -> None:
        request, keep = self._pending.popleft()
        self.deadline = float("inf")  # the handler has limits of its own
        self._busy = asyncio.get_running_loop().create_task(self._serve(request, keep))

    async def _serve(self, request: HttpRequest, keep: bool) -> None:
        try:
            status, body = await self._answer(request)
        finally:
            self._busy = None
            self._release(_held_by(request))
        if self._closing:
            return
        self._write(status, body, keep=keep)
        if not self._writable:
            self._hold_unsent()
        elif keep:
            self._go_on()

    async def _answer(self, request: HttpRequest) -> tuple[bytes, bytes]:
        turns, host = self.server.turns, request.peer.host
        self._waiting = True
        try:
            await turns.enter(host)
        finally:
            self._waiting = False
        try:
            return b"200 OK", await self.server.handler(request)
        except Exception:  # noqa: BLE001 - a defect of ours must not leave the peer without an answer
            _log.exception("a request could not be served", host=request.peer.text, path=request.path[:200])
            return b"500 Internal Server Error", b""
        finally:
            turns.leave(host)

    def _hold_unsent(self) -> None:
        unsent = self._transport.get_write_buffer_size()
        too_much = self.server.visitors.hold(self.peer.host, unsent)
        if too_much is not None:
            self.server.troubled(self.peer, f"an answer is not taken while {too_much}")
            self.abort()
            return
        self._unsent = unsent

    def _release(self, size: int) -> None:
        self.server.visitors.release(self.peer.host, size)

    def _write(self, status: bytes, body: bytes, *, keep: bool, unread: bool = False) -> None:
        """Send a response. `unread`: the request was not read to its end, and what comes of it is thrown away,
        because closing right away would reset the connection and take the answer from the peer.
        """
        connection = b"keep-alive" if keep else b"close"
        head = b"HTTP/1.1 %b\r\nContent-Type: text/xml\r\nContent-Length: %d\r\nConnection: %b\r\n\r\n"
        if self._transport.is_closing():
            return
        self._transport.write(head % (status, len(body), connection) + body)
        if keep:
            return
        self._closing = True
        if unread:
            self.deadline = time.monotonic() + self._limits.linger_seconds
            self._transport.write_eof()
        else:
            self.deadline = time.monotonic() + self._limits.stall_seconds
            self._transport.close()

    def _reject(self, status: bytes, what: str) -> None:
        self._refuse(status, f"{self.peer.text} {what}")

    def _refuse(self, status: bytes, why: str) -> None:
        self.server.troubled(self.peer, why)
        self._write(status, build_fault(int(status[:3]), why), keep=False, unread=True)

    def _turn_away(self, why: str) -> None:
        """One connection too many: it is told so, if not too many are being told."""
        if self.server.visitors.turn_away(self.peer.host):
            self._turned_away = True
            self.server.visitors.connections.add(self)
            self._refuse(b"503 Service Unavailable", why)
        else:
            self._closing = True
            self.server.troubled(self.peer, why)
            self._transport.abort()

    def expire(self) -> None:
        """Called by the sweep when the deadline passed."""
        unsent = self._transport.get_write_buffer_size()
        if unsent < self._unsent:  # slow, but it moves
            self._release(self._unsent - unsent)
            self._unsent = unsent
            self.deadline = time.monotonic() + self._limits.stall_seconds
            return
        if not self._closing and self._in_request and not self._head_done:
            self.server.troubled(self.peer, f"{self.peer.text} did not finish a request in time")
        self.abort()

    def abort(self) -> None:
        """Cut the connection now."""
        self._closing = True
        self._transport.abort()


def _held_by(request: HttpRequest) -> int:
    return _REQUEST_BYTES + len(request.path) + len(request.body)


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
