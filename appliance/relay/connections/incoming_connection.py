"""Accepted connections until their headers are known, and refused connections.

A refused peer gets a TCPROS header with `error=<reason>`. Closing a socket with unread data resets the connection and
loses the reason, so the relay first only shuts it for writing.
"""

import socket
from collections.abc import Callable, Mapping

from appliance.relay.connections.headers import canonical
from appliance.relay.connections.pending_connections import PendingConnections
from appliance.relay.context import RelayContext
from appliance.relay.transport.sockets import BufferedSocket
from roswire.errors import PeerError
from roswire.tcpros import HeaderParser, encode_header


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
            context.loop, sock, self._received, lambda _reason: failed(self, ""), payer=context.payer(host)
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

    def _received(self, data: bytes) -> None:
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
        received, broken, payer = self._received, lambda _reason: self.close(), context.payer(host)
        self._stream = BufferedSocket(context.loop, sock, received, broken, payer=payer, drained=self._told)
        self._stream.send(encode_header({"error": reason}))
        if self.live and not self._stream.backlog:
            self._told()

    def make_room(self) -> None:
        self.close()

    def close(self) -> None:
        if self.live:
            self.live = False
            self._timer.cancel()
            self._stream.close()
            self._ended(self)

    def _told(self) -> None:
        self._stream.finish()

    def _received(self, data: bytes) -> None:
        if not data:
            self.close()
