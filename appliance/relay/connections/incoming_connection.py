"""Accepted connections until their headers are known, and refused connections.

Invariants:
- A peer has `header_seconds` and `header_bytes` for its header. Until then it costs one socket and the bytes it has
  sent, which are counted (`pending_connections`); without memory for them it is refused.
- A refused peer gets a TCPROS header with `error=<reason>` as from any publisher or service, and `farewell` seconds to
  read it. Its connection is shut for writing first: closing over unread data would reset it and lose the reason.
"""

import socket
from collections.abc import Callable, Mapping

from appliance.relay.connections.pending_connections import PendingConnections
from appliance.relay.context import RelayContext
from appliance.relay.loop import EventLoop
from appliance.relay.transport.sockets import BufferedSocket
from roswire.errors import PeerError
from roswire.tcpros import HeaderParser, encode_header


class IncomingConnection:
    """An accepted connection whose header is not complete.

    `introduced(self)` is called when its header (`fields`) and the bytes after it (`rest`) have come, `failed(self,
    reason)` when no header will come. Either ends this stage.
    """

    def __init__(
        self,
        context: RelayContext,
        sock: socket.socket,
        key: str,
        host: str,
        *,
        payer: str,
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
            context.loop, sock, self._received, lambda _reason: failed(self, ""), payer=payer
        )
        self._received_bytes = 0
        pending.enter(self, host)

    def take(self) -> socket.socket:
        """Return the socket, which the caller owns from now on."""
        self._timer.cancel()
        self._pending.leave(self)
        return self._stream.take()

    def wait(self, seconds: float, callback: Callable[[], None]) -> None:
        """Call back later, unless the connection is taken or closed by then."""
        self._timer.cancel()
        self._timer = self._loop.after(seconds, callback)
        self._stream.read(False)

    def close(self) -> None:
        """Close the connection."""
        self._timer.cancel()
        self._pending.leave(self)
        self._stream.close()

    def make_room(self) -> None:
        """End the connection for a peer that has a better claim to its place."""
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
            self.fields, self.rest = fields, self._parser.rest
            self._introduced(self)

    def _late(self) -> None:
        self._failed(self, f"it did not send a connection header within {self._limits.header_seconds:g} s")


class RefusedConnection:
    """A refused peer that has yet to read the reason; `ended(self)` is called when its connection is closed."""

    def __init__(
        self,
        loop: EventLoop,
        sock: socket.socket,
        reason: str,
        seconds: float,
        ended: Callable[["RefusedConnection"], None],
        *,
        payer: str,
    ) -> None:
        self.live = True
        self._ended = ended
        self._timer = loop.after(seconds, self.close)
        self._stream = BufferedSocket(
            loop, sock, self._received, lambda _reason: self.close(), payer=payer, drained=self._told
        )
        self._stream.send(encode_header({"error": reason}))
        if self.live and not self._stream.backlog:
            self._told()

    def make_room(self) -> None:
        """End the connection for a peer that has a better claim to its place."""
        self.close()

    def close(self) -> None:
        """Close the connection now."""
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
