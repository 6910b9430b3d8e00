"""Connections of REST: uvicorn's protocol with limits that it does not have itself.

Invariants:

1. At most `connections` are open, and `connections_per_host` of one peer; one more is closed at once.
2. A connection whose TLS handshake, or whose next request's headers, take longer than `header_seconds` is closed;
   so is one whose headers are longer than `_HEAD_BYTES` (uvicorn would keep all of them).
3. Whoever sends anything after an answer has as long to begin, and to end the headers of, the next request: neither
   an empty line nor the rest of a body keeps a connection open.
4. At most `_MOST_PIPELINED` requests of a connection wait behind the one that is being answered.
"""

import asyncio
import socket
import ssl
from collections import Counter
from typing import Any

from starlette.types import ASGIApp
from uvicorn.config import Config
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.server import ServerState

from appliance.api.rates import peer_key
from appliance.config import ApiLimits

_KEEP_ALIVE_SECONDS = 30
_HEAD_BYTES = 64 << 10
_MOST_PIPELINED = 16
_END_SECONDS = 1.0


class Visitors:
    """Counts the connections of each peer."""

    def __init__(self, limits: ApiLimits) -> None:
        self._limits = limits
        self._of: Counter[str] = Counter()

    def come(self, host: str) -> bool:
        """Whether one more connection of this peer is served."""
        key = peer_key(host)
        if self._of.total() >= self._limits.connections or self._of[key] >= self._limits.connections_per_host:
            return False
        self._of[key] += 1
        return True

    def go(self, host: str) -> None:
        """A connection that was served has ended."""
        key = peer_key(host)
        self._of[key] -= 1
        if not self._of[key]:
            del self._of[key]


class GuardedProtocol(HttpToolsProtocol):
    """One connection."""

    def __init__(self, config: Config, state: ServerState, visitors: Visitors, header_seconds: float) -> None:
        super().__init__(config, state, {})
        self._visitors = visitors
        self._header_seconds = header_seconds
        self._visitor: str | None = None
        self._deadline: asyncio.TimerHandle | None = None
        self._head = 0  # bytes that came since headers are expected
        self._leftover = False  # what came after an answer has not begun a request yet

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn has it
        """Serve a new connection, unless there are too many."""
        peer = transport.get_extra_info("peername")
        if peer is None or not self._visitors.come(peer[0]):
            transport.abort()
            return
        self._visitor = peer[0]
        # asyncio does it for sockets that were made with the protocol's number only; else an answer's body waits 40 ms.
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        super().connection_made(transport)
        self._expect_headers()

    def connection_lost(self, exc: Exception | None) -> None:
        """Count the connection out."""
        if self._visitor is None:
            return
        self._visitors.go(self._visitor)
        self._visitor = None
        self._headers_are_there()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse what came."""
        if self._visitor is None:
            return
        if self._deadline is not None and not self._leftover:
            self._head += len(data)
        super().data_received(data)
        if self._deadline is None and (self.cycle is None or self.cycle.response_complete):
            # uvicorn has just put its own timer off; what came may be no request at all.
            self._leftover = True
            self._expect_headers()
        if self._deadline is not None and self._head > _HEAD_BYTES:
            self.transport.abort()

    def on_message_begin(self) -> None:
        """A request begins."""
        super().on_message_begin()
        if self._leftover:
            self._headers_are_there()
        self._expect_headers()

    def on_headers_complete(self) -> None:
        """Its headers are there. Raises ValueError for one too many, which the parser makes a 400 of."""
        if len(self.pipeline) >= _MOST_PIPELINED:
            raise ValueError("too many requests wait")
        self._headers_are_there()
        super().on_headers_complete()

    def _expect_headers(self) -> None:
        if self._deadline is None:
            self._deadline = self.loop.call_later(self._header_seconds, self.transport.abort)

    def _headers_are_there(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
            self._head = 0
            self._leftover = False


class Listener:
    """Serves `app` on a listening socket."""

    def __init__(self, app: ASGIApp, limits: ApiLimits) -> None:
        self._limits = limits
        self._config = Config(
            app,
            http=GuardedProtocol,
            ws="none",
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_keep_alive=_KEEP_ALIVE_SECONDS,
            h11_max_incomplete_event_size=None,
        )
        self._config.load()
        self._state = ServerState()
        self._visitors = Visitors(limits)
        self._server: asyncio.Server | None = None

    async def start(self, sock: socket.socket, context: ssl.SSLContext | None) -> None:
        """Begin to accept."""
        more: dict[str, Any] = {}
        if context is not None:
            more = {
                "ssl_handshake_timeout": self._limits.header_seconds,
                "ssl_shutdown_timeout": _END_SECONDS,
            }
        self._server = await asyncio.get_running_loop().create_server(
            lambda: GuardedProtocol(self._config, self._state, self._visitors, self._limits.header_seconds),
            sock=sock,
            ssl=context,
            backlog=256,
            **more,
        )

    async def stop(self) -> None:
        """Stop accepting, let what is being answered finish for a second, close the rest."""
        if self._server is not None:
            self._server.close()
        for connection in list(self._state.connections):
            connection.shutdown()
        if self._state.tasks:
            await asyncio.wait(list(self._state.tasks), timeout=_END_SECONDS)
        for connection in list(self._state.connections):
            connection.transport.abort()
