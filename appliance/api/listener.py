"""Connections of REST: uvicorn's protocol with limits that it does not have itself.

Invariants:

1. A connection has a place among the arrivals before anything is made for it, TLS included; else it is closed at once.
2. A connection whose TLS handshake, or whose next request's headers, take longer than `header_seconds` is closed;
   so is one whose headers are longer than `_HEAD_BYTES` (uvicorn would keep all of them).
3. Whoever sends anything after an answer has as long to begin, and to end the headers of, the next request: neither
   an empty line nor the rest of a body keeps a connection open.
4. At most `_MOST_PIPELINED` requests of a connection wait behind the one that is being answered.
"""

import asyncio
import errno
import socket
import ssl
from collections.abc import Callable
from typing import Any

import structlog
from starlette.types import ASGIApp
from uvicorn.config import Config
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.server import ServerState

from appliance.api.arrivals import Arrival, Arrivals
from appliance.config import ApiLimits
from appliance.shares.descriptors import connections_within
from appliance.shares.pool import Standing
from appliance.shares.table import REST_CONNECTIONS

_log = structlog.get_logger()
_GONE = frozenset({errno.ECONNABORTED, errno.EINTR, errno.EPROTO})
_PAUSE = 0.2  # when the process has no descriptor left
_BACKLOG = 256
_KEEP_ALIVE_SECONDS = 30
_HEAD_BYTES = 64 << 10
_MOST_PIPELINED = 16
_END_SECONDS = 1.0


class GuardedProtocol(HttpToolsProtocol):
    """One connection."""

    def __init__(
        self,
        config: Config,
        state: ServerState,
        arrivals: Arrivals,
        arrival: Arrival,
        header_seconds: float,
    ) -> None:
        super().__init__(config, state, {})
        self._arrivals = arrivals
        self._arrival = arrival
        self._header_seconds = header_seconds
        self._open = False
        self._deadline: asyncio.TimerHandle | None = None
        self._head = 0  # bytes that came since headers are expected
        self._leftover = False  # what came after an answer has not begun a request yet

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn has it
        """Serve a new connection."""
        if transport.get_extra_info("peername") is None:  # gone already
            transport.abort()
            return
        self._open = True
        # asyncio does it for sockets that were made with the protocol's number only; else an answer's body waits 40 ms.
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        super().connection_made(transport)
        self._expect_headers()

    def connection_lost(self, exc: Exception | None) -> None:
        """Count the connection out."""
        self._arrivals.go(self._arrival)
        if not self._open:
            return
        self._open = False
        self._headers_are_there()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse what came."""
        if not self._open:
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
        self._arrivals.served(self._arrival)
        super().on_headers_complete()

    def on_response_complete(self) -> None:
        """An answer is sent."""
        super().on_response_complete()
        if self._open and not self.pipeline:
            self._arrivals.waits(self._arrival)

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
    """Serves `app` on a listening socket. `standing(peer)` says whether a peer has shown a good token lately."""

    def __init__(self, app: ASGIApp, limits: ApiLimits, standing: Callable[[str], Standing]) -> None:
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
        bounds = REST_CONNECTIONS.bounds.sized(
            connections_within(limits.connections), limits.connections_per_host
        )
        self.arrivals = Arrivals(bounds, standing)
        self._opening: set[asyncio.Task[None]] = set()
        self._accepting: asyncio.Task[None] | None = None

    async def start(self, sock: socket.socket, context: ssl.SSLContext | None) -> None:
        """Begin to accept."""
        sock.setblocking(False)
        sock.listen(_BACKLOG)
        self._accepting = asyncio.get_running_loop().create_task(self._accept(sock, context))

    async def stop(self) -> None:
        """Stop accepting, let what is being answered finish for a second, close the rest."""
        tasks = [*self._opening, *filter(None, [self._accepting])]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for connection in list(self._state.connections):
            connection.shutdown()
        if self._state.tasks:
            await asyncio.wait(list(self._state.tasks), timeout=_END_SECONDS)
        for connection in list(self._state.connections):
            connection.transport.abort()

    async def _accept(self, listening: socket.socket, context: ssl.SSLContext | None) -> None:
        loop = asyncio.get_running_loop()
        with listening:
            while True:
                try:
                    sock, address = await loop.sock_accept(listening)
                except OSError as error:
                    if error.errno not in _GONE:
                        _log.error("REST cannot accept a connection", reason=str(error))
                        await asyncio.sleep(_PAUSE)
                    continue
                arrival = self.arrivals.come(sock, address[0])
                if arrival is None:
                    sock.close()
                    continue
                task = loop.create_task(self._open(arrival, context))
                self._opening.add(task)
                task.add_done_callback(self._opening.discard)

    async def _open(self, arrival: Arrival, context: ssl.SSLContext | None) -> None:
        """Hand the connection to its protocol, after the handshake if there is one."""
        timeouts: dict[str, Any] = {}
        if context is not None:
            timeouts = {
                "ssl_handshake_timeout": self._limits.header_seconds,
                "ssl_shutdown_timeout": _END_SECONDS,
            }
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: GuardedProtocol(
                    self._config, self._state, self.arrivals, arrival, self._limits.header_seconds
                ),
                arrival.socket,
                ssl=context,
                **timeouts,
            )
        except OSError:  # it is gone, or what it says is no TLS
            self.arrivals.go(arrival)
            arrival.socket.close()
        except BaseException:
            self.arrivals.go(arrival)
            arrival.cut()
            raise
