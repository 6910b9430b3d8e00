"""Serve XML-RPC over HTTP on a listening socket, one request at a time for each connection.

1. Each connection has at most one request in progress and one response in the write buffer. Further requests wait,
   and reading pauses.
2. A request from a host that no policy rule names is refused before its body is complete. Only the beginning of the
   body is read, for the audit record of the refusal.
3. A request leaves the queue when its connection ends. If a request need not wait, its last bytes are not counted.
4. A peer that exceeds a limit gets a fault that names the limit. At most a few connections wait for such a fault.
"""

import asyncio
import socket
import struct
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from typing import NamedTuple, cast

import structlog

from appliance.base import clock
from appliance.policy.model import Address, plain_address
from appliance.rpc.acceptor import BACKLOG, Acceptor, Program, SourceQueues
from appliance.rpc.connection_table import ConnectionTable, Stage
from appliance.rpc.fair_queue import Turns
from appliance.rpc.front import Front, HttpLimits
from appliance.rpc.processor_time import HostTask, ProcessorTime
from roswire.xmlrpc import build_fault

_log = structlog.get_logger()

_RESET = struct.pack("ii", 1, 0)  # SO_LINGER: a close resets the connection

# ROS clients wait for an answer before the next request. Other clients may send requests earlier, up to this number.
_MAX_PIPELINED = 512
# The bytes that count for a request in addition to body and path. They are ten times its memory, because thousands of
# small requests take time.
_REQUEST_BYTES = 4096
_OPENING_SECONDS = 50e-6  # the processor time to open and close a transport
_READ_AT_ONCE = 8192  # the bytes that are read and parsed in one piece
_BEGINNING = 4096  # the bytes of a refused body that are read for its audit record
_BEGINNING_SECONDS = 1.0  # the longest wait for these bytes


@dataclass(frozen=True, slots=True)
class Peer:
    """The other end of a connection, which connected to `local`. `here`: it is on this machine."""

    host: Address
    text: str
    local: str
    here: bool = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "here", self.host.is_loopback or self.text == self.local)


class HttpRequest(NamedTuple):
    """A request; `arrived` is when its last byte came (monotonic ns)."""

    peer: Peer
    path: str
    body: bytes
    arrived: int


Handler = Callable[[HttpRequest], Awaitable[bytes]]

Refusal = Callable[[bytes], bytes]
"""A function that answers a refused request, from the beginning of its body."""


class NoAnswerError(Exception):
    """Raised by a handler to reset the connection, as if the node were gone."""


@dataclass(eq=False)
class HttpServer:
    """A server; `handler` returns the response body of a request.

    `refuse(peer)` is called after the head of a request; the `Refusal` makes the answer from the beginning of the
    body. `malformed(peer, reason)` is called for each request that is invalid HTTP or not served here, and
    `troubled(peer, reason)` when a peer exceeds a limit.
    """

    sock: socket.socket
    handler: Handler
    _: KW_ONLY
    limits: HttpLimits
    connection_table: ConnectionTable[Address]
    turns: Turns[Address]
    time: ProcessorTime
    first: Program | None = None
    keep: bool = True
    refuse: Callable[[Peer], Refusal | None] = lambda peer: None  # noqa: ARG005 - documents the parameter
    troubled: Callable[[Peer, str], None] = lambda peer, reason: None  # noqa: ARG005 - same
    malformed: Callable[[Peer, str], None] = lambda peer, reason: None  # noqa: ARG005 - same
    connections: "set[_Connection]" = field(default_factory=set, init=False)
    buffer: bytearray = field(default_factory=lambda: bytearray(_READ_AT_ONCE), init=False)
    """The receive buffer of all connections: the event loop fills it and calls `buffer_updated` in one step."""
    _acceptors: list[Acceptor] = field(default_factory=list, init=False)
    _queues: SourceQueues | None = field(default=None, init=False)
    _opening: set[asyncio.Task[None]] = field(default_factory=set, init=False)
    _complaining: set[Address] = field(default_factory=set, init=False)  # hosts with an unrecorded complaint
    _closed: bool = field(default=False, init=False)

    async def start(self) -> None:
        self._acceptors.append(Acceptor(self.sock, self.time, self._accepted))
        if self.first is None:
            return
        try:
            self._queues = SourceQueues(self.sock, self.first, BACKLOG)
        except OSError as error:
            _log.error("all hosts share one queue of new connections", reason=str(error))
        else:
            self._acceptors.append(Acceptor(self._queues.second, self.time, self._accepted, paced=True))

    def close(self) -> None:
        self._closed = True
        for acceptor in self._acceptors:
            acceptor.close()
        for connection in list(self.connections):
            connection.abort()

    def _accepted(self, sock: socket.socket, host: Address) -> bool:
        if self._queues is not None:
            self._queues.update()
        too_many = self.connection_table.arriving.take(host)
        if not too_many:
            sock.setblocking(False)
            self.time.run(host, partial(self._admit, sock, host))
            return True
        sock.close()
        if host not in self._complaining:
            self._complaining.add(host)
            self.time.run(host, partial(self._complain, host, too_many))
        return False

    def _admit(self, sock: socket.socket, host: Address) -> None:
        self.connection_table.arriving.give_back(host)
        if self._closed or _has_ended(sock):
            sock.close()
            return
        connection = _Connection(self, sock, host)
        if not connection.enter():
            sock.close()
            return
        task = asyncio.get_running_loop().create_task(self._open(connection, sock))
        self._opening.add(task)
        task.add_done_callback(self._opening.discard)
        self.time.charge(host, _OPENING_SECONDS)

    def _complain(self, host: Address, too_many: str) -> None:
        self._complaining.discard(host)
        self.troubled(Peer(host, str(host), ""), too_many)

    async def _open(self, connection: "_Connection", sock: socket.socket) -> None:
        try:
            await asyncio.get_running_loop().connect_accepted_socket(lambda: connection, sock)
        except OSError:  # the peer is gone
            connection.leave()
            sock.close()
        except BaseException:
            connection.abort()
            sock.close()
            raise


class _Connection(Front, asyncio.BufferedProtocol):
    most_waiting = _MAX_PIPELINED
    fields = frozenset({b"content-length", b"content-encoding", b"expect"})

    def __init__(self, server: HttpServer, sock: socket.socket, host: Address) -> None:
        super().__init__(server.limits, server.connection_table, sock)
        self.server = server
        self.peer = Peer(host, str(host), str(plain_address(sock.getsockname()[0])))
        self._counted = False
        self._too_many = ""  # the reason if the connection is refused
        self._unparsed = b""  # input that waits for the host's turn
        self._busy: HostTask[None] | None = None  # serves a request that waits
        self._waiting = False  # whether the request waits for a slot
        self._has_slot = False
        self._pending: deque[tuple[HttpRequest, bool]] = deque()
        self._body = bytearray()
        self._held = 0  # bytes of the body that are counted
        self._serving = 0  # counted bytes of the request being served
        self._unsent = 0  # counted bytes of an answer that the peer has not read
        self._refusal: Refusal | None = None
        self._patience: asyncio.TimerHandle | None = None  # ends the wait of a refusal for the body
        self._writable = True

    # --- asyncio.Protocol ---

    def enter(self) -> bool:
        self._too_many = self.connection_table.enter(self, self.peer.host)
        self._counted = not self._too_many
        if self._too_many and not self.connection_table.turn_away(self, self.peer.host):
            self.closing = True
            self.server.troubled(self.peer, self._too_many)
            return False
        self.server.connections.add(self)
        return True

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        if self.open(cast(asyncio.Transport, transport)) and self._too_many:
            self._refuse(b"503 Service Unavailable", self._too_many)

    def connection_lost(self, _error: Exception | None) -> None:
        self.leave()

    def get_buffer(self, _size: int) -> bytearray:
        return self.server.buffer

    def buffer_updated(self, size: int) -> None:
        data = bytes(memoryview(self.server.buffer)[:size])
        if self._unparsed:
            self._unparsed += data
            self.transport.pause_reading()
        else:
            self._unparsed = data
            self.server.time.run(self.peer.host, self._parse_read)

    def _parse_read(self) -> None:
        data, self._unparsed = self._unparsed, b""
        if not self.closing:
            self.parse(data)
        if not (self._pending or self.transport.is_closing()):
            self.transport.resume_reading()

    def parse(self, data: bytes) -> None:
        super().parse(data)
        if self.closing or not (self.in_request and self.head_done):
            return
        if not self._body_is_held():
            return
        if self.received - len(self._body) > self.limits.framing_bytes:
            self.reject(b"400 Bad Request", "sent more chunk sizes and trailers than a request may have")
        elif self.is_quiet:
            self.allow(self.limits.stall_seconds)

    @property
    def is_quiet(self) -> bool:
        return self._busy is None and self._writable

    @property
    def waiting(self) -> int:
        return len(self._pending)

    def pause_writing(self) -> None:
        self._writable = False
        self.allow(self.limits.stall_seconds)

    def resume_writing(self) -> None:
        self._writable = True
        self._release(self._unsent)
        self._unsent = 0
        if not self.closing and self._busy is None:
            self._go_on()

    # --- httptools callbacks ---

    def on_message_begin(self) -> None:
        super().on_message_begin()
        self._url = b""
        self._expects = False

    def on_url(self, url: bytes) -> None:
        self._url += url
        super().on_url(url)

    def on_field(self, name: bytes, value: bytes) -> None:
        if name == b"content-length" and value.isdigit() and int(value) > self.limits.body_bytes:
            self.reject(
                b"413 Content Too Large",
                f"announced a body of {int(value)} bytes; the limit is {self.limits.body_bytes}",
            )
        elif name == b"content-encoding" and value.lower() != b"identity":
            encoding = value[:20].decode("latin-1")
            what = f"sent a body encoded as {encoding!a}; send it as it is, without Content-Encoding"
            self.reject(b"415 Unsupported Media Type", what)
        elif name == b"expect" and value.lower() == b"100-continue":
            self._expects = True

    def on_headers_complete(self) -> None:
        super().on_headers_complete()
        if self.closing:
            return
        if self.parser.get_method() != b"POST":
            self.reject(b"405 Method Not Allowed", "did not POST")
            return
        if self.parser.should_upgrade():
            self.reject(b"501 Not Implemented", "asked for another protocol")
            return
        self._refusal = self.server.refuse(self.peer)
        if self._expects and self._refusal is not None:
            self._refuse_request(self._refusal)
        elif self._refusal is not None:
            later = asyncio.get_running_loop().call_later
            self._patience = later(_BEGINNING_SECONDS, self._refuse_request, self._refusal)
        elif self._expects:
            self.transport.write(b"HTTP/1.1 100 Continue\r\n\r\n")

    def on_body(self, piece: bytes) -> None:
        if self.closing:
            return
        if len(self._body) + len(piece) > self.limits.body_bytes:
            self.reject(b"413 Content Too Large", f"sent a body beyond {self.limits.body_bytes} bytes")
            return
        self._body += piece
        if self._refusal is not None and len(self._body) >= _BEGINNING:
            self._refuse_request(self._refusal)

    def on_message_complete(self) -> None:
        if self.closing:
            return
        if self._refusal is not None:
            self._refuse_request(self._refusal)
            return
        keep = self.server.keep and self.parser.should_keep_alive()
        request = HttpRequest(self.peer, self._url.decode("latin-1"), bytes(self._body), clock.now_ns())
        served = self.is_quiet and not self._pending
        if not served and not self._holds(_held_by(request) - self._held, "sent a request"):
            return
        super().on_message_complete()
        held, self._body, self._held = self._held, bytearray(), 0
        if served:
            self._begin(request, keep, held)
            return
        self._pending.append((request, keep))
        if self.is_quiet:
            self._serve_next()
        else:
            self.transport.pause_reading()

    def _holds(self, size: int, what: str) -> bool:
        """Count bytes. If there are too many, refuse the request and return False."""
        too_much = self.connection_table.hold(self.peer.host, size)
        if too_much:
            self.reject(b"503 Service Unavailable", f"{what} while {too_much}")
        return not too_much

    def _body_is_held(self) -> bool:
        unheld = len(self._body) - self._held
        if unheld and not self._holds(unheld, "sent a body"):
            return False
        self._held += unheld
        return True

    def _refuse_request(self, refusal: Refusal) -> None:
        if self._patience is not None:
            self._patience.cancel()
        self._write(b"200 OK", refusal(bytes(self._body[:_BEGINNING])), keep=False, unread=True)

    @property
    def holding(self) -> int:
        return self._held + self._unsent + sum(_held_by(request) for request, _ in self._pending)

    def leave(self) -> None:
        """Leave the table. A request being served continues, but its answer is dropped."""
        if self._patience is not None:
            self._patience.cancel()
        self.server.connections.discard(self)
        if self._counted:
            self._counted = False
            self._release(self.holding)
            self._body, self._held, self._unsent = bytearray(), 0, 0
        super().leave()
        self._pending.clear()
        if self._busy is not None and self._waiting:
            self._busy.cancel()

    # --- serving ---

    def _go_on(self) -> None:
        self.allow(self.limits.idle_seconds)
        closing = self.transport.is_closing()
        finished = not (self._pending or self.in_request or closing)
        self.connection_table.file(self, Stage.IDLE if finished else Stage.UNFINISHED)
        if self._pending:
            asyncio.get_running_loop().call_soon(self.server.time.run, self.peer.host, self._serve_next)
        elif not (closing or self._unparsed):
            self.transport.resume_reading()

    def _serve_next(self) -> None:
        if self._pending and self.is_quiet:
            request, keep = self._pending.popleft()
            self._begin(request, keep, _held_by(request))

    def _begin(self, request: HttpRequest, keep: bool, held: int) -> None:
        """Serve a request, of which `held` bytes are counted; the others count once it waits."""
        self.deadline = float("inf")  # the handler has limits of its own
        self._serving = held
        serving = HostTask(self.server.time, self.peer.host, self._serve(request, keep))
        if serving.done():
            return
        self._busy = serving
        more = _held_by(request) - held
        if self._has_slot:
            self.connection_table.held.charge(self.peer.host, more)
        elif not self._holds(more, "sent a request"):
            serving.cancel()
            return
        self._serving += more
        self.connection_table.file(self, Stage.SERVED if self._has_slot else Stage.UNFINISHED)

    async def _serve(self, request: HttpRequest, keep: bool) -> None:
        try:
            status, body = (b"", b"") if self.closing else await self._answer(request)
        except NoAnswerError:
            self._reset()
            return
        finally:
            self._busy = None
            self._release(self._serving)
            self._serving = 0
        if self.closing:
            self.connection_table.file(self, Stage.UNFINISHED)
        else:
            self._sent(status, body, keep=keep)

    def _sent(self, status: bytes, body: bytes, *, keep: bool) -> None:
        self._write(status, body, keep=keep)
        if keep and self._writable:
            self._go_on()
            return
        self.connection_table.file(self, Stage.UNFINISHED)  # until the peer has read its answer
        if not self._writable:
            self._hold_unsent()

    async def _answer(self, request: HttpRequest) -> tuple[bytes, bytes]:
        turns, host = self.server.turns, request.peer.host
        self._waiting = True
        try:
            await turns.enter(host)
        finally:
            self._waiting = False
        self._has_slot = True
        if self._busy is not None:
            self.connection_table.file(self, Stage.SERVED)
        try:
            return b"200 OK", await self.server.handler(request)
        except NoAnswerError:
            raise
        except Exception:  # noqa: BLE001 - the peer gets an answer even after a defect of the handler
            _log.exception("a request could not be served", host=request.peer.text, path=request.path[:200])
            return b"500 Internal Server Error", b""
        finally:
            self._has_slot = False
            turns.leave(host)

    def _hold_unsent(self) -> None:
        unsent = self.transport.get_write_buffer_size()
        too_much = self.connection_table.hold(self.peer.host, unsent)
        if too_much:
            self.server.troubled(self.peer, f"an answer is not taken while {too_much}")
            self.abort()
            return
        self._unsent = unsent

    def _release(self, size: int) -> None:
        if size:
            self.connection_table.release(self.peer.host, size)

    def _write(self, status: bytes, body: bytes, *, keep: bool, unread: bool = False) -> None:
        """Write an answer; without `keep`, close the connection.

        `unread`: the rest of the request is read and dropped for a while, because an immediate close would reset the
        connection and the peer would lose the answer.
        """
        connection = b"keep-alive" if keep else b"close"
        head = b"HTTP/1.1 %b\r\nContent-Type: text/xml\r\nContent-Length: %d\r\nConnection: %b\r\n\r\n"
        if self.transport.is_closing():
            return
        self.transport.write(head % (status, len(body), connection) + body)
        if keep:
            return
        self.closing = True
        if unread:
            self._release(self._held)
            self._body, self._held = bytearray(), 0
            self.allow(self.limits.linger_seconds)
            self.transport.write_eof()
        else:
            self.allow(self.limits.stall_seconds)
            self.transport.close()

    def reject(self, status: bytes, what: str) -> None:
        self._refuse(status, f"{self.peer.text} {what}")

    def _refuse(self, status: bytes, why: str) -> None:
        report = self.server.troubled if exceeds_limit(status) else self.server.malformed
        report(self.peer, why)
        self._write(status, build_fault(int(status[:3]), why), keep=False, unread=True)

    def expire(self) -> None:
        if self._unparsed or not self.is_open:  # the appliance causes the delay, not the peer
            self.allow(self.limits.stall_seconds)
            return
        unsent = self.transport.get_write_buffer_size()
        if unsent < self._unsent:  # the peer reads slowly
            self._release(self._unsent - unsent)
            self._unsent = unsent
            self.allow(self.limits.stall_seconds)
            return
        if not self.closing and self.in_request and not self.head_done:
            self.server.troubled(self.peer, f"{self.peer.text} did not finish a request in time")
        self.abort()

    def _reset(self) -> None:
        self.transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        self.abort()


def _has_ended(sock: socket.socket) -> bool:
    """Return whether the peer closed the connection: opening its transport would take a hundred times as long."""
    try:
        return not sock.recv(1, socket.MSG_PEEK)
    except BlockingIOError:
        return False
    except OSError:
        return True


def _held_by(request: HttpRequest) -> int:
    return _REQUEST_BYTES + len(request.path) + len(request.body)


def listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_STREAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        sock.bind((host, port))
        sock.listen(BACKLOG)
    except OSError:
        sock.close()
        raise
    return sock


def exceeds_limit(status: bytes) -> bool:
    return status[:3] in (b"413", b"431", b"503")
