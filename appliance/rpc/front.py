"""Limit the connections of every HTTP server of the appliance: RVMaster, the proxy endpoints, and REST.

1. A connection is in the `ConnectionTable` from its acceptance to its end, including the TLS handshake.
2. The TLS handshake and the head of a request take at most `head_seconds` each.
3. The sweep of the table closes a connection without progress, whatever its state.
"""

import asyncio
import contextlib
import socket
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import httptools

from appliance.base import clock
from appliance.rpc.connection_table import ConnectionTable, Stage

# The bytes around each header field; they count for the size of a head.
_FIELD_FRAMING = len(": \r\n")


@dataclass(frozen=True, slots=True)
class HttpLimits:
    """The limits of HTTP; sizes are in bytes, times in seconds."""

    head_bytes: int = 64 << 10
    head_seconds: float = 10.0
    body_bytes: int = 16 << 20
    stall_seconds: float = 30.0
    idle_seconds: float = 300.0
    linger_seconds: float = 2.0

    @property
    def framing_bytes(self) -> int:
        return self.head_bytes + self.body_bytes // 16


class Front(asyncio.BaseProtocol, ABC):
    """The reading side of one connection. With `sock`, it is counted before it has a transport.

    The server behind it answers the parsed requests, of which at most `most_waiting` wait.
    """

    transport: asyncio.Transport
    most_waiting: int
    fields: frozenset[bytes] = frozenset()
    """The lower-case names of header fields that are given to `on_field`."""

    def __init__(
        self, limits: HttpLimits, connection_table: ConnectionTable[Any], sock: socket.socket | None = None
    ) -> None:
        self.limits = limits
        self.connection_table = connection_table
        self.closing = False
        self.in_request = False
        self.head_done = False
        self.received = 0  # bytes of the present request, including framing
        self._begins = (
            False  # whether the present piece of input began a request, and no answer is in progress
        )
        self._socket = sock
        self._head_bytes = 0
        self.allow(limits.head_seconds)

    def allow(self, seconds: float) -> None:
        self.progress = clock.now()
        self.deadline = self.progress + seconds

    @abstractmethod
    def reject(self, status: bytes, what: str) -> None:
        """Answer, then close the connection. `what` describes the peer's action."""

    @property
    @abstractmethod
    def waiting(self) -> int:
        """Return the number of requests that wait while another one is served."""

    @property
    @abstractmethod
    def is_quiet(self) -> bool:
        """Whether no answer is in progress, so that the next head has a deadline."""

    @property
    def is_open(self) -> bool:
        return self._socket is None

    def open(self, transport: asyncio.Transport) -> bool:
        self.transport, self._socket = transport, None
        if self.closing or not transport.get_extra_info("peername"):
            self.abort()
            return False
        # asyncio sets TCP_NODELAY only for sockets with a protocol number. Without it, an answer's body waits 40 ms.
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.parser = httptools.HttpRequestParser(self)
        self.allow(self.limits.head_seconds)
        return True

    def parse(self, data: bytes) -> None:
        if self.closing:
            return
        try:
            self.parser.feed_data(data)
        except httptools.HttpParserUpgrade:
            pass  # the server refused the request after its head, or ignores the upgrade
        except httptools.HttpParserError as error:
            if not self.closing:
                self.reject(b"400 Bad Request", f"sent something that is not HTTP: {error}")
        if self._begins:
            self._begins = False
            self._await_rest()
        if self.in_request and not self.closing:
            self.received += len(data)
            if not self.head_done and self.received > self.limits.head_bytes:
                self._reject_head()

    def _await_rest(self) -> None:
        if self.is_quiet and (self.in_request or self.closing):
            self.connection_table.file(self, Stage.UNFINISHED)
            if not self.closing:
                self.allow(self.limits.head_seconds)

    def on_message_begin(self) -> None:
        if self.waiting >= self.most_waiting and not self.closing:
            what = f"sent {self.most_waiting} requests more while one was being answered"
            self.reject(b"400 Bad Request", what)
        if self.closing:
            raise ConnectionAbortedError  # ignore the rest of the input
        self.in_request, self.head_done = True, False
        self.received = self._head_bytes = 0
        self._begins = self.is_quiet

    def on_url(self, url: bytes) -> None:
        self._head_bytes += len(url)
        if self._head_bytes > self.limits.head_bytes and not self.closing:
            self._reject_head()

    def on_header(self, name: bytes, value: bytes) -> None:
        self._head_bytes += len(name) + len(value) + _FIELD_FRAMING
        if self._head_bytes > self.limits.head_bytes and not self.closing:
            self._reject_head()
        lowered = name.lower()
        if lowered in self.fields and not self.closing:
            self.on_field(lowered, value)

    def on_field(self, name: bytes, value: bytes) -> None:
        """Take a header field of `fields`."""

    def on_headers_complete(self) -> None:
        self.head_done = True

    def on_message_complete(self) -> None:
        self.in_request = False

    def _reject_head(self) -> None:
        self.reject(b"431 Request Header Fields Too Large", "sent a request head beyond the limit")

    @property
    def holding(self) -> int:
        return 0

    def leave(self) -> None:
        self.closing = True
        self.connection_table.leave(self)

    def expire(self) -> None:
        self.abort()

    def abort(self) -> None:
        self.leave()
        if self._socket is None:
            self.transport.abort()
        else:
            with contextlib.suppress(OSError):  # later reads and writes report the end
                self._socket.shutdown(socket.SHUT_RDWR)
