"""The bounded front of every HTTP server of the appliance: RVMaster's, the faces' and REST's.

It reads what a connection sends with a parser of its own (httptools) and bounds it; the server behind it serves the
requests. Invariants:

1. A connection has a place among the `Visitors` from the moment it is accepted, its TLS handshake included.
2. A handshake takes at most `head_seconds`, and so does the head of a request; a head has at most `head_bytes`.
3. At most `most_waiting` requests of a connection wait while one is being answered.
4. A connection that makes no progress is closed by the sweep, whatever state it is in.
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
from appliance.rpc.connection_table import Stage, Visitors

# A head of many short fields is as long as the bytes it came in.
_FIELD_FRAMING = len(": \r\n")


@dataclass(frozen=True, slots=True)
class HttpLimits:
    """Bounds of the HTTP layer; bytes and seconds."""

    head_bytes: int = 64 << 10
    head_seconds: float = 10.0
    body_bytes: int = 16 << 20
    stall_seconds: float = 30.0
    idle_seconds: float = 300.0
    linger_seconds: float = 2.0

    @property
    def framing_bytes(self) -> int:
        """What a request may have beside its body: the head, chunk sizes, trailers."""
        return self.head_bytes + self.body_bytes // 16


class Front(asyncio.BaseProtocol, ABC):
    """One connection; `sock` where it has a place before there is a transport."""

    transport: asyncio.Transport
    most_waiting: int

    def __init__(
        self, limits: HttpLimits, visitors: Visitors[Any], sock: socket.socket | None = None
    ) -> None:
        self.limits = limits
        self.visitors = visitors
        self.closing = False
        self.in_request = False
        self.head_done = False
        self.received = 0  # bytes of the request that is being read, framing included
        self._socket = sock
        self._head_bytes = 0
        self.allow(limits.head_seconds)

    def allow(self, seconds: float) -> None:
        """So long may pass until the next progress."""
        self.deadline = time.monotonic() + seconds

    @abstractmethod
    def reject(self, status: bytes, what: str) -> None:
        """Answer with this status, and close: `what` the peer did, in words."""

    @property
    @abstractmethod
    def waiting(self) -> int:
        """Requests that wait behind the one that is being answered."""

    @property
    @abstractmethod
    def is_quiet(self) -> bool:
        """Whether nothing is being answered: then the next head has its deadline."""

    @property
    def is_open(self) -> bool:
        """Whether there is a transport."""
        return self._socket is None

    def open(self, transport: asyncio.Transport) -> bool:
        """Begin with the transport; False (and it is cut) for a connection that has ended already."""
        self.transport, self._socket = transport, None
        if self.closing or not transport.get_extra_info("peername"):
            self.abort()
            return False
        # asyncio does it for sockets that were made with the protocol's number only; else an answer's body waits 40 ms.
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.parser = httptools.HttpRequestParser(self)
        self.allow(self.limits.head_seconds)
        return True

    def parse(self, data: bytes) -> None:
        """Parse a piece of what came, within the limits."""
        if self.closing:
            return
        try:
            self.parser.feed_data(data)
        except httptools.HttpParserUpgrade:
            pass  # the server has refused it when its head was complete, or goes on without
        except httptools.HttpParserError as error:
            if not self.closing:
                self.reject(b"400 Bad Request", f"sent something that is not HTTP: {error}")
        if self.in_request and not self.closing:
            self.received += len(data)
            if not self.head_done and self.received > self.limits.head_bytes:
                self._reject_head()

    def on_message_begin(self) -> None:
        """A request begins."""
        if self.waiting >= self.most_waiting and not self.closing:
            what = f"sent {self.most_waiting} requests more while one was being answered"
            self.reject(b"400 Bad Request", what)
        if self.closing:
            raise ConnectionAbortedError  # what else came is not looked at
        self.in_request, self.head_done = True, False
        self.received = self._head_bytes = 0
        if self.is_quiet:
            self.visitors.file(self, Stage.UNFINISHED)
            self.allow(self.limits.head_seconds)

    def on_url(self, url: bytes) -> None:
        """A piece of the path."""
        self._head_bytes += len(url)
        if self._head_bytes > self.limits.head_bytes and not self.closing:
            self._reject_head()

    def on_header(self, name: bytes, value: bytes) -> None:
        """One field."""
        self._head_bytes += len(name) + len(value) + _FIELD_FRAMING
        if self._head_bytes > self.limits.head_bytes and not self.closing:
            self._reject_head()

    def on_headers_complete(self) -> None:
        """The head is there."""
        self.head_done = True

    def on_message_complete(self) -> None:
        """The request is there."""
        self.in_request = False

    def _reject_head(self) -> None:
        self.reject(b"431 Request Header Fields Too Large", "sent a request head beyond the limit")

    @property
    def holding(self) -> int:
        """Bytes that are held for it and that its end sets free."""
        return 0

    def leave(self) -> None:
        """Count for nothing any more; to say it twice is fine."""
        self.closing = True
        self.visitors.leave(self)

    def expire(self) -> None:
        """Called by the sweep when the deadline has passed."""
        self.abort()

    def abort(self) -> None:
        """Cut the connection now; it counts for nothing from here on."""
        self.leave()
        if self._socket is None:
            self.transport.abort()
        else:
            with contextlib.suppress(OSError):  # whoever reads or writes there finds the end
                self._socket.shutdown(socket.SHUT_RDWR)


def plain_address(text: str) -> Address:
    """The address without scope, an IPv4 address in IPv6 clothes as the IPv4 address it is."""
    address = address_of(text.partition("%")[0])
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        return address_of(str(address.ipv4_mapped))
    return address
