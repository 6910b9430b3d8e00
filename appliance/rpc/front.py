"""Bound the connections of every HTTP server of the appliance: RVMaster, the proxy endpoints, and REST.

The front reads with a parser of its own (httptools), within limits; the server behind it serves the requests.
Invariants:

1. A connection has a place among the `ConnectionTable` from the time it is accepted, TLS handshake included.
2. A handshake and the head of a request take at most `head_seconds` each; a head has at most `head_bytes`.
3. At most `most_waiting` requests of a connection wait behind one.
4. The sweep closes a connection without progress in every state.
"""

import asyncio
import contextlib
import ipaddress
import socket
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import httptools

from appliance.policy.model import Address, address_of
from appliance.rpc.connection_table import ConnectionTable, Stage

# Counts the bytes around each field, so that a head of many short fields has its full size.
_FIELD_FRAMING = len(": \r\n")


@dataclass(frozen=True, slots=True)
class HttpLimits:
    """The bounds of the HTTP layer, in bytes and seconds."""

    head_bytes: int = 64 << 10
    head_seconds: float = 10.0
    body_bytes: int = 16 << 20
    stall_seconds: float = 30.0
    idle_seconds: float = 300.0
    linger_seconds: float = 2.0

    @property
    def framing_bytes(self) -> int:
        """Return the bytes that a request may have besides its body: head, chunk sizes, trailers."""
        return self.head_bytes + self.body_bytes // 16


class Front(asyncio.BaseProtocol, ABC):
    """The reading side of one connection. With `sock`, it has a place before it has a transport."""

    transport: asyncio.Transport
    most_waiting: int

    def __init__(
        self, limits: HttpLimits, connection_table: ConnectionTable[Any], sock: socket.socket | None = None
    ) -> None:
        self.limits = limits
        self.connection_table = connection_table
        self.closing = False
        self.in_request = False
        self.head_done = False
        self.received = 0  # bytes of the present request, framing included
        self._socket = sock
        self._head_bytes = 0
        self.allow(limits.head_seconds)

    def allow(self, seconds: float) -> None:
        """Set the deadline of the next progress."""
        self.deadline = time.monotonic() + seconds

    @abstractmethod
    def reject(self, status: bytes, what: str) -> None:
        """Answer with this status and close the connection. `what` describes the peer's act."""

    @property
    @abstractmethod
    def waiting(self) -> int:
        """Return the number of requests behind the present one."""

    @property
    @abstractmethod
    def is_quiet(self) -> bool:
        """Whether no answer is under way, so that the next head has a deadline."""

    @property
    def is_open(self) -> bool:
        """Whether it has a transport."""
        return self._socket is None

    def open(self, transport: asyncio.Transport) -> bool:
        """Begin with the transport. Return False and cut it if the connection has ended already."""
        self.transport, self._socket = transport, None
        if self.closing or not transport.get_extra_info("peername"):
            self.abort()
            return False
        # asyncio sets it only for sockets with a protocol number; without it an answer's body waits 40 ms.
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.parser = httptools.HttpRequestParser(self)
        self.allow(self.limits.head_seconds)
        return True

    def parse(self, data: bytes) -> None:
        """Parse a piece of input, within the limits."""
        if self.closing:
            return
        try:
            self.parser.feed_data(data)
        except httptools.HttpParserUpgrade:
            pass  # the server refused it after its head, or goes on without an upgrade
        except httptools.HttpParserError as error:
            if not self.closing:
                self.reject(b"400 Bad Request", f"sent something that is not HTTP: {error}")
        if self.in_request and not self.closing:
            self.received += len(data)
            if not self.head_done and self.received > self.limits.head_bytes:
                self._reject_head()

    def on_message_begin(self) -> None:
        """Begin a request."""
        if self.waiting >= self.most_waiting and not self.closing:
            what = f"sent {self.most_waiting} requests more while one was being answered"
            self.reject(b"400 Bad Request", what)
        if self.closing:
            raise ConnectionAbortedError  # ignore the rest of the input
        self.in_request, self.head_done = True, False
        self.received = self._head_bytes = 0
        if self.is_quiet:
            self.connection_table.file(self, Stage.UNFINISHED)
            self.allow(self.limits.head_seconds)

    def on_url(self, url: bytes) -> None:
        """Count a piece of the path."""
        self._head_bytes += len(url)
        if self._head_bytes > self.limits.head_bytes and not self.closing:
            self._reject_head()

    def on_header(self, name: bytes, value: bytes) -> None:
        """Count one field."""
        self._head_bytes += len(name) + len(value) + _FIELD_FRAMING
        if self._head_bytes > self.limits.head_bytes and not self.closing:
            self._reject_head()

    def on_headers_complete(self) -> None:
        """End the head."""
        self.head_done = True

    def on_message_complete(self) -> None:
        """End the request."""
        self.in_request = False

    def _reject_head(self) -> None:
        self.reject(b"431 Request Header Fields Too Large", "sent a request head beyond the limit")

    @property
    def holding(self) -> int:
        """Return the bytes held for it, which its end releases."""
        return 0

    def leave(self) -> None:
        """Leave the counts; a second call is fine."""
        self.closing = True
        self.connection_table.leave(self)

    def expire(self) -> None:
        """Handle a passed deadline."""
        self.abort()

    def abort(self) -> None:
        """Cut the connection now, and leave the counts."""
        self.leave()
        if self._socket is None:
            self.transport.abort()
        else:
            with contextlib.suppress(OSError):  # readers and writers find the end
                self._socket.shutdown(socket.SHUT_RDWR)


def plain_address(text: str) -> Address:
    """Return the address without scope; an IPv4-mapped IPv6 address as IPv4."""
    address = address_of(text.partition("%")[0])
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        return address_of(str(address.ipv4_mapped))
    return address
