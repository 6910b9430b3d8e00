"""An accepted connection until its header is known, and the reasons to turn it away.

Invariants:
- A peer has `header_seconds` and `header_bytes` for its header; until then it costs one socket and what it
  has sent, which is counted (`anteroom`): without room for that it is turned away.
- A refused peer gets a TCPROS header with `error=<reason>` as from any publisher or service, and `farewell`
  seconds to read it: its connection is shut for writing first, because closing over unread data would reset
  it and destroy the reason on its way.
"""

import socket
from collections.abc import Callable, Mapping

from appliance.relay.connections.pending_connections import Anteroom
from appliance.relay.connections.sockets import Stream
from appliance.relay.context import RelayContext
from appliance.relay.loop import Loop
from roswire.errors import PeerError
from roswire.tcpros import HeaderParser, encode_header


class Visitor:
    """A peer that has connected to a relay port and has not said yet what it wants.

    `introduced(visitor)` is called when its header (`fields`) and what followed it (`rest`) are there;
    `failed(visitor, reason)` when there will be none. Either ends this stage.
    """

    def __init__(
        self,
        context: RelayContext,
        sock: socket.socket,
        key: str,
        host: str,
        *,
        payer: str,
        anteroom: Anteroom,
        introduced: Callable[["Visitor"], None],
        failed: Callable[["Visitor", str], None],
    ) -> None:
        self.key = key
        self.host = host
        self.fields: Mapping[str, str] = {}
        self.rest = b""
        self._loop = context.loop
        self._limits = limits = context.limits
        self._introduced = introduced
        self._failed = failed
        self._anteroom = anteroom
        self._parser = HeaderParser(limits.header_bytes)
        self._timer = context.loop.after(limits.header_seconds, self._late)
        self._stream = Stream(
            context.loop, sock, self._received, lambda _reason: failed(self, ""), payer=payer
        )
        self._received_bytes = 0
        anteroom.enter(self, host)

    def take(self) -> socket.socket:
        """Hand the socket over."""
        self._timer.cancel()
        self._anteroom.leave(self)
        return self._stream.take()

    def wait(self, seconds: float, callback: Callable[[], None]) -> None:
        """Neither served nor refused yet: call back, unless it is taken or gone by then."""
        self._timer.cancel()
        self._timer = self._loop.after(seconds, callback)
        self._stream.read(False)

    def close(self) -> None:
        """Cut the connection."""
        self._timer.cancel()
        self._anteroom.leave(self)
        self._stream.close()

    def make_room(self) -> None:
        """Somebody else has more right to its place."""
        self._failed(self, "it waited longest when there was no room for others")

    def _received(self, data: bytes) -> None:
        if not data:
            self._failed(self, "")
            return
        self._received_bytes += len(data)
        too_much = self._anteroom.hold(self, self._received_bytes)
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


class Farewell:
    """A refused peer that is told why; `ended(self)` when its connection is closed."""

    def __init__(
        self,
        loop: Loop,
        sock: socket.socket,
        reason: str,
        seconds: float,
        ended: Callable[["Farewell"], None],
        *,
        payer: str,
    ) -> None:
        self.live = True
        self._ended = ended
        self._timer = loop.after(seconds, self.close)
        self._stream = Stream(
            loop, sock, self._received, lambda _reason: self.close(), payer=payer, drained=self._told
        )
        self._stream.send(encode_header({"error": reason}))
        if self.live and not self._stream.backlog:
            self._told()

    def make_room(self) -> None:
        """Somebody else has more right to its place."""
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
