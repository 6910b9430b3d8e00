"""Accepted connections until their headers are known, and refused connections.

A refused peer gets a TCPROS header with `error=<reason>`. Closing a socket with unread data resets the connection and
loses the reason, so the relay first only shuts it for writing.
"""

import socket
from collections.abc import Callable, Mapping
from typing import Protocol

from appliance.quotas.pool import Queue, QuotaClass
from appliance.relay.connections.headers import canonical
from appliance.relay.context import RelayContext
from appliance.relay.transport.memory import HeldBytes, MemoryPool
from appliance.relay.transport.sockets import BufferedSocket
from roswire.errors import PeerError
from roswire.tcpros import HeaderParser, encode_header

# Connections that are not served yet: the memory for their headers, and the order in which they are ended.
#
# - The first `_FREE` bytes of a header are not counted, so a flood of long headers does not keep out normal ones.
# - Connections of hosts without a grant are ended first, the longest wait first. A connection of another host is
# ended
#   only after `_PATIENCE` seconds.

_FREE = 4096
_PATIENCE = 1.0


class PendingConnection(Protocol):
    """A connection that is not served yet, or a refused one."""

    def make_room(self) -> None:
        """End now, and `leave`."""


class PendingConnections:
    """The connections that are not served yet."""

    def __init__(
        self, clock: Callable[[], float], quota_class: Callable[[str], QuotaClass], headers: MemoryPool
    ) -> None:
        self._clock = clock
        self._quota_class = quota_class
        self._held: dict[PendingConnection, HeldBytes] = {}
        self._headers = headers
        self._waiting: Queue[str, PendingConnection] = Queue(quota_class)
        self._with_long_headers: Queue[str, PendingConnection] = Queue(quota_class)

    def enter(self, guest: PendingConnection, host: str) -> None:
        self._held[guest] = HeldBytes(self._headers.of(host))
        self._waiting.put(guest, host, self._clock())

    def leave(self, guest: PendingConnection) -> None:
        self._waiting.remove(guest)
        self._with_long_headers.remove(guest)
        held = self._held.pop(guest, None)
        if held is not None:
            held.set(0)

    def hold(self, guest: PendingConnection, size: int) -> str:
        held = self._held[guest]
        share, more = held.share, max(0, size - _FREE) - held.size
        if more <= 0:
            return ""
        why = share.refusal(more)
        while (
            why
            and share.used + more <= self._headers.bounds.host
            and self._end_longest(self._with_long_headers, share.host, but=guest)
        ):
            why = share.refusal(more)
        if not why:
            if not held.size:
                self._with_long_headers.put(guest, share.host, self._clock())
            held.set(held.size + more)
        return why

    def make_room(self, host: str) -> bool:
        return self._end_longest(self._waiting, host)

    def _end_longest(
        self, queue: Queue[str, PendingConnection], host: str, *, but: PendingConnection | None = None
    ) -> bool:
        mine = self._quota_class(host)
        for quota_class in QuotaClass:
            found = queue.longest(quota_class) if quota_class <= mine else None
            if found is None or found[0] is but:
                continue
            young = self._clock() - found[2] < _PATIENCE
            if quota_class is QuotaClass.REGISTERED and young:
                continue
            found[0].make_room()
            return True
        return False


class IncomingConnection:
    """An accepted connection whose header is not complete.

    `introduced(self)` or `failed(self, reason)` ends this stage; `rest` has the bytes after the header.
    """

    def __init__(
        self,
        context: RelayContext,
        sock: socket.socket,
        key: str,
        host: str,
        *,
        pending: PendingConnections,
        introduced: Callable[["IncomingConnection"], None],
        failed: Callable[["IncomingConnection", str], None],
    ) -> None:
        self.key = key
        self.host = host
        self.fields: Mapping[str, str] = {}
        self.rest = b""
        self._loop = context.loop
        self._limits = limits = context.limits
        self._introduced = introduced
        self._failed = failed
        self._pending = pending
        self._parser = HeaderParser(limits.header_bytes)
        self._timer = context.loop.after(limits.header_seconds, self._late)
        self._stream = BufferedSocket(
            context.loop, sock, self._on_data, lambda _reason: failed(self, ""), payer=context.payer(host)
        )
        self._received_bytes = 0
        pending.enter(self, host)

    def take(self) -> socket.socket:
        self._timer.cancel()
        self._pending.leave(self)
        return self._stream.take()

    def wait(self, seconds: float, callback: Callable[[], None]) -> None:
        self._timer.cancel()
        self._timer = self._loop.after(seconds, callback)
        self._stream.read(False)

    def close(self) -> None:
        self._timer.cancel()
        self._pending.leave(self)
        self._stream.close()

    def make_room(self) -> None:
        self._failed(self, "it waited longest when the limit of connections was reached")

    def _on_data(self, data: bytes) -> None:
        if not data:
            self._failed(self, "")
            return
        self._received_bytes += len(data)
        too_much = self._pending.hold(self, self._received_bytes)
        if too_much:
            self._failed(self, too_much)
            return
        try:
            fields = self._parser.feed(data)
        except PeerError as error:
            self._failed(self, f"its header cannot be read: {error}")
            return
        if fields is not None:
            self.fields, self.rest = canonical(fields), self._parser.rest
            self._introduced(self)

    def _late(self) -> None:
        self._failed(self, f"it did not send a connection header within {self._limits.header_seconds:g} s")


class RefusedConnection:
    """A refused peer that has not read the reason yet."""

    def __init__(
        self,
        context: RelayContext,
        sock: socket.socket,
        host: str,
        reason: str,
        ended: Callable[["RefusedConnection"], None],
    ) -> None:
        self.host = host
        self.live = True
        self._ended = ended
        self._timer = context.loop.after(context.limits.farewell, self.close)
        received, broken, payer = self._on_data, lambda _reason: self.close(), context.payer(host)
        self._stream = BufferedSocket(context.loop, sock, received, broken, payer=payer, drained=self._tell)
        self._stream.send(encode_header({"error": reason}))
        if self.live and not self._stream.backlog:
            self._tell()

    def make_room(self) -> None:
        self.close()

    def close(self) -> None:
        if self.live:
            self.live = False
            self._timer.cancel()
            self._stream.close()
            self._ended(self)

    def _tell(self) -> None:
        self._stream.finish()

    def _on_data(self, data: bytes) -> None:
        if not data:
            self.close()
