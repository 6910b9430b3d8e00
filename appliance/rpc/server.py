"""HTTP for XML-RPC: requests off a listening socket, under limits, one at a time per connection.

`Front` parses and bounds heads. Invariants beside its own:

1. Nothing is buffered beyond the limits: body by `Limits.body`, one request in flight per connection (reading pauses
   once a second one came; what is in the same piece of 8 KiB waits), one response in the write buffer (the next request
   is not served before it is sent).
2. An address that no rule names is answered before its body is read, but for the beginning: what it asked for is told
   in the refusal's record.
3. Accepting, reading, and each step of a handler are charged to the host and wait for its turn (`processor_time`).
   Connections, the bytes that they hold (`visitors`) and requests being served (`turns`) have shares for each host,
   for strangers, and for hosts with a registration.
4. Who is gone before it was his turn is not served: a request waits only as long as its connection lives.
5. Who goes over a limit is told so, in a fault that says which; of connections that are too many, a few at a time.
"""

import asyncio
import socket
import struct
import time
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from typing import NamedTuple, cast

import structlog

from appliance.policy.model import Address
from appliance.rpc.acceptor import BACKLOG, Acceptor
from appliance.rpc.connection_table import Stage, Visitors
from appliance.rpc.fair_queue import Turns
from appliance.rpc.front import Front, HttpLimits, plain_address
from appliance.rpc.processor_time import ProcessorTime
from roswire.xmlrpc import build_fault

_log = structlog.get_logger()

_RESET = struct.pack("ii", 1, 0)  # SO_LINGER: what is closed is reset

# ROS clients send the next request after the answer. More is read than that, but not so much that it takes long.
_MOST_PIPELINED = 512
# What a request counts beside its body and its path: ten times its memory, because thousands of small ones take time.
_REQUEST_BYTES = 4096
_OPENING_SECONDS = 50e-6  # of processor time, that the loop takes to open and close a transport
_READ_AT_ONCE = 8192  # bytes that are read and parsed in one piece
_BEGINNING = 4096  # bytes of a body that are looked at to say what was refused
_BEGINNING_SECONDS = 1.0  # that they are waited for


@dataclass(frozen=True, slots=True)
class Peer:
    """Who is connected: `host` and `text` are the peer's address, `local` the address he reached us at.

    `here`: he is on this machine.
    """

    host: Address
    text: str
    local: str
    here: bool = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "here", self.host.is_loopback or self.text == self.local)


class HttpRequest(NamedTuple):
    """A whole POST: the path asked for, the body, and when its last byte arrived (monotonic ns)."""

    peer: Peer
    path: str
    body: bytes
    arrived: int


Handler = Callable[[HttpRequest], Awaitable[bytes]]

AtOnce = Callable[[HttpRequest], bytes | None]
"""Answers a request where that takes no time and waits for nothing; else None, and the handler has it."""

Refusal = Callable[[bytes], bytes]
"""Makes the answer to a request that is not served, of the beginning of its body."""


def not_at_once(_request: HttpRequest) -> bytes | None:
    """Of a server whose handler has every request."""
    return None


class NoAnswerError(Exception):
    """A handler raises it where the peer is to find its connection reset, as at a node that is gone."""


@dataclass(eq=False)
class HttpServer:
    """Serves one listening socket: each request goes to `handler`, whose bytes are the response body.

    `refuse(peer)` is asked when the head of a request is there: what it returns is given the beginning of the body, as
    far as it comes in time, and the bytes that it makes of it are sent instead of reading
    the body, and the connection is closed. Without `keep` each answer ends its connection.
    `troubled(peer, reason)` hears of every limit that was hit.
    """

    sock: socket.socket
    handler: Handler
    _: KW_ONLY
    at_once: AtOnce = not_at_once
    limits: HttpLimits
    visitors: Visitors[Address]
    turns: Turns
    time: ProcessorTime
    keep: bool = True
    refuse: Callable[[Peer], Refusal | None] = lambda peer: None  # noqa: ARG005 - names the parameter
    troubled: Callable[[Peer, str], None] = lambda peer, reason: None  # noqa: ARG005 - same
    connections: "set[_Connection]" = field(default_factory=set, init=False)
    _acceptor: Acceptor | None = field(default=None, init=False)
    _opening: set[asyncio.Task[None]] = field(default_factory=set, init=False)
    _complaining: set[Address] = field(default_factory=set, init=False)  # hosts of which a record waits
    _closed: bool = field(default=False, init=False)

    async def start(self) -> None:
        """Begin to accept."""
        self._acceptor = Acceptor(self.sock, self.time, self._accepted)

    def close(self) -> None:
        """Stop accepting and cut what is connected; the listening socket is closed with it."""
        self._closed = True
        if self._acceptor is not None:
            self._acceptor.close()
        for connection in list(self.connections):
            connection.abort()

    def _accepted(self, sock: socket.socket, host: Address) -> bool:
        """The connection waits until it is its host's turn to be opened; one too many is closed (False)."""
        too_many = self.visitors.arriving.take(host)
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
        """A place for the connection, and its transport."""
        self.visitors.arriving.give_back(host)
        connection = _Connection(self, sock, host)
        if self._closed or not connection.enter():
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
        except OSError:  # it is gone
            connection.leave()
            sock.close()
        except BaseException:
            connection.abort()
            sock.close()
            raise


class _Connection(Front, asyncio.BufferedProtocol):
    """One connection: serves its requests one after the other."""

    most_waiting = _MOST_PIPELINED

    def __init__(self, server: HttpServer, sock: socket.socket, host: Address) -> None:
        super().__init__(server.limits, server.visitors, sock)
        self.server = server
        self.peer = Peer(host, str(host), str(plain_address(sock.getsockname()[0])))
        self._counted = False
        self._too_many = ""  # why it is turned away
        self._unparsed = b""  # what was read, until it is the host's turn
        self._busy: asyncio.Task[None] | None = None
        self._waiting = False  # for its turn
        self._pending: deque[tuple[HttpRequest, bool]] = deque()
        self._body = bytearray()
        self._held = 0  # bytes of it that are counted
        self._unsent = 0  # bytes of an answer that the peer does not take, as they were counted
        self._refusal: Refusal | None = None
        self._patience: asyncio.TimerHandle | None = None  # until that answer waits for the body no longer
        self._writable = True

    # --- asyncio.Protocol ---

    def enter(self) -> bool:
        """Take a place; False (and it is closed) where there is neither one nor room to say so."""
        self._too_many = self.visitors.enter(self, self.peer.host)
        self._counted = not self._too_many
        if self._too_many and not self.visitors.turn_away(self, self.peer.host):
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
        self._buffer = bytearray(_READ_AT_ONCE)
        return self._buffer

    def buffer_updated(self, size: int) -> None:
        self._unparsed = bytes(memoryview(self._buffer)[:size])
        if not self.server.time.run(self.peer.host, self._parse_read):
            self.transport.pause_reading()

    def _parse_read(self) -> None:
        data, self._unparsed = self._unparsed, b""
        if not self.closing:
            self.parse(data)
        if not (self._pending or self.transport.is_closing()):
            self.transport.resume_reading()

    def parse(self, data: bytes) -> None:
        """As `Front`, and a body within its limits."""
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
        """As `Front`; an answer that is not taken is not given yet."""
        return self._busy is None and self._writable

    @property
    def waiting(self) -> int:
        """As `Front`."""
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

    def on_header(self, name: bytes, value: bytes) -> None:
        super().on_header(name, value)
        if self.closing:
            return
        lowered = name.lower()
        if lowered == b"content-length" and value.isdigit() and int(value) > self.limits.body_bytes:
            self.reject(
                b"413 Content Too Large",
                f"announced a body of {int(value)} bytes; the limit is {self.limits.body_bytes}",
            )
        elif lowered == b"content-encoding" and value.lower() != b"identity":
            encoding = value[:20].decode("latin-1")
            what = f"sent a body encoded as {encoding!a}; send it as it is, without Content-Encoding"
            self.reject(b"415 Unsupported Media Type", what)
        elif lowered == b"expect" and value.lower() == b"100-continue":
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
        request = HttpRequest(self.peer, self._url.decode("latin-1"), bytes(self._body), time.monotonic_ns())
        if self.is_quiet and not self._pending and self._answered_at_once(request, keep=keep):
            if self._held:
                self._release(self._held)
            self._body, self._held = bytearray(), 0
            return
        size = len(self._body) - self._held + _REQUEST_BYTES + len(self._url)
        too_much = self.visitors.hold(self.peer.host, size)
        if too_much:
            self.reject(b"503 Service Unavailable", f"sent a request while {too_much}")
            return
        super().on_message_complete()
        self._body, self._held = bytearray(), 0
        self._pending.append((request, keep))
        if self.is_quiet:
            self._serve_next()
        else:
            self.transport.pause_reading()

    def _body_is_held(self) -> bool:
        """Count what came of the body; False (and it is refused) where that is too much."""
        unheld = len(self._body) - self._held
        too_much = self.visitors.hold(self.peer.host, unheld) if unheld else ""
        if too_much:
            self.reject(b"503 Service Unavailable", f"sent a body while {too_much}")
            return False
        self._held += unheld
        return True

    def _refuse_request(self, refusal: Refusal) -> None:
        """Answer without having read more than the beginning of the body."""
        if self._patience is not None:
            self._patience.cancel()
        self._write(b"200 OK", refusal(bytes(self._body[:_BEGINNING])), keep=False, unread=True)

    @property
    def holding(self) -> int:
        """Bytes that are held for it and that its end sets free: not those of a request that is being served."""
        return self._held + self._unsent + sum(_held_by(request) for request, _ in self._pending)

    def leave(self) -> None:
        """Count for nothing any more, once; what is being served goes on, and its answer is thrown away."""
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
        """The answer is sent: the next request, if it is there, or wait for one."""
        self.allow(self.limits.idle_seconds)
        closing = self.transport.is_closing()
        finished = not (self._pending or self.in_request or closing)
        self.visitors.file(self, Stage.IDLE if finished else Stage.UNFINISHED)
        if self._pending:
            self._serve_next()
        elif not (closing or self._unparsed):
            self.transport.resume_reading()

    def _answered_at_once(self, request: HttpRequest, *, keep: bool) -> bool:
        """Answer without a task and without a slot: it takes time, which is the host's, and nothing else."""
        answer = self.server.at_once(request)
        if answer is None:
            return False
        super().on_message_complete()
        self._sent(b"200 OK", answer, keep=keep)
        return True

    def _serve_next(self) -> None:
        request, keep = self._pending.popleft()
        self.deadline = float("inf")  # the handler has limits of its own
        serving = self.server.time.spend(self.peer.host, self._serve(request, keep))
        self._busy = asyncio.get_running_loop().create_task(serving)

    async def _serve(self, request: HttpRequest, keep: bool) -> None:
        try:
            status, body = (b"", b"") if self.closing else await self._answer(request)
        except NoAnswerError:
            self._reset()
            return
        finally:
            self._busy = None
            self._release(_held_by(request))
        if self.closing:
            self.visitors.file(self, Stage.UNFINISHED)
        else:
            self._sent(status, body, keep=keep)

    def _sent(self, status: bytes, body: bytes, *, keep: bool) -> None:
        """Send an answer, and go on once it is taken."""
        self._write(status, body, keep=keep)
        if keep and self._writable:
            self._go_on()
            return
        self.visitors.file(self, Stage.UNFINISHED)  # until its answer is taken
        if not self._writable:
            self._hold_unsent()

    async def _answer(self, request: HttpRequest) -> tuple[bytes, bytes]:
        turns, host = self.server.turns, request.peer.host
        self._waiting = True
        try:
            await turns.enter(host)
        finally:
            self._waiting = False
        self.visitors.file(self, Stage.SERVED)
        try:
            return b"200 OK", await self.server.handler(request)
        except NoAnswerError:
            raise
        except Exception:  # noqa: BLE001 - a defect of ours must not leave the peer without an answer
            _log.exception("a request could not be served", host=request.peer.text, path=request.path[:200])
            return b"500 Internal Server Error", b""
        finally:
            turns.leave(host)

    def _hold_unsent(self) -> None:
        unsent = self.transport.get_write_buffer_size()
        too_much = self.visitors.hold(self.peer.host, unsent)
        if too_much:
            self.server.troubled(self.peer, f"an answer is not taken while {too_much}")
            self.abort()
            return
        self._unsent = unsent

    def _release(self, size: int) -> None:
        self.visitors.release(self.peer.host, size)

    def _write(self, status: bytes, body: bytes, *, keep: bool, unread: bool = False) -> None:
        """Send a response. `unread`: the request was not read to its end, and what comes of it is thrown away,
        because closing right away would reset the connection and take the answer from the peer.
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
        """Tell the peer which limit it went over, in a fault."""
        self._refuse(status, f"{self.peer.text} {what}")

    def _refuse(self, status: bytes, why: str) -> None:
        self.server.troubled(self.peer, why)
        self._write(status, build_fault(int(status[:3]), why), keep=False, unread=True)

    def expire(self) -> None:
        """Called by the sweep when the deadline passed."""
        if self._unparsed or not self.is_open:  # it is we who are late
            self.allow(self.limits.stall_seconds)
            return
        unsent = self.transport.get_write_buffer_size()
        if unsent < self._unsent:  # slow, but it moves
            self._release(self._unsent - unsent)
            self._unsent = unsent
            self.allow(self.limits.stall_seconds)
            return
        if not self.closing and self.in_request and not self.head_done:
            self.server.troubled(self.peer, f"{self.peer.text} did not finish a request in time")
        self.abort()

    def _reset(self) -> None:
        """Cut the connection so that the peer sees it broken, not ended."""
        self.transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        self.abort()


def _held_by(request: HttpRequest) -> int:
    return _REQUEST_BYTES + len(request.path) + len(request.body)


def listen(host: str, port: int) -> socket.socket:
    """A TCP socket bound to `host:port` (port 0: one that is free), listening; `::` takes IPv4 as well."""
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
