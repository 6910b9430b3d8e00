"""Accept connections of REST with `rpc/front`, which RVMaster also uses; uvicorn serves them.

1. A connection is entered in the connection table before anything (such as TLS) is set up for it. If the table is
   full, it is closed at once.
2. A peer is known if it recently sent a valid token or is on this machine. A connection of an unknown peer may be
   closed at any time to admit another peer. A connection of a known peer is closed only for another known peer, after
   a second.
3. Connections are opened in the order of the processor time that their peers used. All unknown peers together count
   as one peer.
4. The deadline for the head of the next request starts with the first byte after an answer, so neither an empty line
   nor the rest of a body keeps a connection open.
"""

import asyncio
import math
import socket
import ssl
from collections.abc import Callable, Coroutine
from functools import partial
from typing import cast

from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.config import Config
from uvicorn.server import ServerState

from appliance.api.front.websockets import PREFIX, WebSocketHandover, WebSocketPassage
from appliance.configuration.settings import ApiLimits
from appliance.policy.model import Address
from appliance.quotas.descriptors import connections_within
from appliance.quotas.peers import peer_key
from appliance.quotas.pool import QuotaClass
from appliance.quotas.table import REST_CONNECTIONS
from appliance.rpc.acceptor import Acceptor
from appliance.rpc.connection_table import ConnectionTable, Stage
from appliance.rpc.front import Front, HttpLimits
from appliance.rpc.processor_time import ProcessorTime

_HANDSHAKE_SECONDS = 0.002  # processor time of a TLS handshake on a slow machine
_KEEP_ALIVE_SECONDS = 30
_END_SECONDS = 1.0
_CONNECTION = "rosrv.connection"  # the key of the connection in a request's state


class _Connection(Front, asyncio.Protocol):
    """Passes the bytes that the front accepts to uvicorn's protocol."""

    most_waiting = 16
    _uvicorn = asyncio.Protocol()  # does nothing until uvicorn's protocol replaces it

    def __init__(self, listener: "Listener", sock: socket.socket) -> None:
        super().__init__(listener.limits, listener.connection_table, sock)
        self._listener = listener
        self._unanswered = 0  # requests without an answer whose head has arrived
        self._rests = False  # whether no byte has arrived since the last answer
        self._head = bytearray()  # of the first request, which may open a WebSocket
        self._target = b""
        self._is_first = True
        self._websocket: WebSocketPassage | None = None

    @property
    def is_quiet(self) -> bool:
        return not self._unanswered

    @property
    def waiting(self) -> int:
        return self._unanswered - 1

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        if self.open(cast(asyncio.Transport, transport)):
            # Ignore data after the last request of a connection, as uvicorn's own parser does.
            self.parser.set_dangerous_leniencies(lenient_data_after_close=True)
            self._uvicorn = self._listener.protocol_of(self)
            self._uvicorn.connection_made(transport)

    def connection_lost(self, error: Exception | None) -> None:
        self.leave()
        if self._websocket is not None:
            self._websocket.client_left()
        self._uvicorn.connection_lost(error)

    def data_received(self, data: bytes) -> None:
        if self._websocket is not None:
            self._websocket.from_client(data)
            return
        if self._rests:
            self._rests = False
            self.allow(self.limits.head_seconds)
        if self._is_first:
            self._head += data
        self.parse(data)
        if self.closing:
            return
        if not self._passed_on():
            self._uvicorn.data_received(data)

    def _passed_on(self) -> bool:
        if self._websocket is None:
            return False
        self._listener.pass_on(self._websocket, bytes(self._head))
        return True

    def pause_writing(self) -> None:
        if self._websocket is not None:
            self._websocket.hold_service(held=True)
        self._uvicorn.pause_writing()

    def resume_writing(self) -> None:
        if self._websocket is not None:
            self._websocket.hold_service(held=False)
        self._uvicorn.resume_writing()

    def on_url(self, url: bytes) -> None:
        super().on_url(url)
        if self._is_first:
            self._target += url

    def on_headers_complete(self) -> None:
        super().on_headers_complete()
        self._unanswered += 1
        self.deadline = math.inf  # body and answer have their own deadlines (`api/request_gate`)
        self.connection_table.file(self, Stage.SERVED)
        if self._is_first and self._listener.opens_websocket(self._target) and self.parser.should_upgrade():
            self._websocket = WebSocketPassage(self.transport, self._target)
        elif self._is_first:
            self._head.clear()  # it may have a large part of the body
        self._is_first = False

    def answered(self) -> None:
        self._unanswered -= 1
        if self._unanswered:
            return
        begun = self.in_request and not self.head_done
        self._rests = not begun
        self.allow(self.limits.head_seconds if begun else self.limits.idle_seconds)
        self.connection_table.file(self, Stage.UNFINISHED if begun else Stage.IDLE)

    def reject(self, _status: bytes, what: str) -> None:
        """Answer, then discard the bytes that the peer still sends: closing with unread bytes would lose the answer."""
        self.closing = True
        self.transport.pause_reading()
        said = f"The peer {what}.\n".encode()
        head = "HTTP/1.1 400 Bad Request\r\nContent-Type: text/plain; charset=utf-8\r\n"
        self.transport.write(
            f"{head}Content-Length: {len(said)}\r\nConnection: close\r\n\r\n".encode() + said
        )
        if self.transport.can_write_eof():
            self.transport.write_eof()
        self.allow(self.limits.linger_seconds)


def _class_of(quota_class: Callable[[str], QuotaClass], host: Address) -> str:
    peer = peer_key(str(host))
    return "" if quota_class(peer) is QuotaClass.UNKNOWN else peer


def _patience(quota_class: QuotaClass, stage: Stage, _own: bool) -> float:
    if quota_class is QuotaClass.UNKNOWN:
        return 0.0
    return math.inf if stage is Stage.SERVED else 1.0


class Listener:
    """The listener of REST; `quota_class(peer)` distinguishes known from unknown peers."""

    def __init__(
        self,
        app: ASGIApp,
        limits: ApiLimits,
        quota_class: Callable[[str], QuotaClass],
        websockets: WebSocketHandover | None = None,
    ) -> None:
        self._app = app
        self._websockets = websockets
        self._config = Config(
            self._serve,
            interface="asgi3",
            http="httptools",
            ws="none",
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_keep_alive=_KEEP_ALIVE_SECONDS,
        )
        self._config.load()
        self._state = ServerState()
        self.limits = HttpLimits(head_seconds=limits.header_seconds, idle_seconds=_KEEP_ALIVE_SECONDS)
        bounds = REST_CONNECTIONS.bounds.resize(
            connections_within(limits.connections), limits.connections_per_host
        )
        self.connection_table: ConnectionTable[str] = ConnectionTable(
            quota_class, connections=bounds, patience=_patience
        )
        self._tasks: set[asyncio.Task[None]] = set()
        self._acceptor: Acceptor | None = None
        self._time = ProcessorTime(partial(_class_of, quota_class))

    def opens_websocket(self, target: bytes) -> bool:
        return self._websockets is not None and target.startswith(PREFIX)

    def pass_on(self, passage: WebSocketPassage, head: bytes) -> None:
        if self._websockets is not None:
            self._begin(self._websockets.pass_on(passage, head))

    def protocol_of(self, connection: _Connection) -> asyncio.Protocol:
        make = cast(Callable[..., asyncio.Protocol], self._config.http_protocol_class)
        return make(config=self._config, server_state=self._state, app_state={_CONNECTION: connection})

    async def _serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        connection: _Connection = scope["state"].pop(_CONNECTION)

        async def sending(message: Message) -> None:
            await send(message)
            if message["type"] == "http.response.body" and not message.get("more_body"):
                connection.answered()

        await self._app(scope, receive, sending)

    def _begin(self, work: Coroutine[object, object, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def start(self, sock: socket.socket, context: ssl.SSLContext | None) -> None:
        self._acceptor = Acceptor(sock, self._time, partial(self._accepted, context))
        self._begin(self.connection_table.sweep())

    async def stop(self) -> None:
        if self._acceptor is not None:
            self._acceptor.close()
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for protocol in list(self._state.connections):
            protocol.shutdown()
        if self._state.tasks:
            await asyncio.wait(list(self._state.tasks), timeout=_END_SECONDS)
        for connection in self.connection_table.connections:
            connection.abort()

    def _accepted(self, context: ssl.SSLContext | None, sock: socket.socket, host: Address) -> bool:
        connection = _Connection(self, sock)
        if self.connection_table.enter(connection, peer_key(str(host))):
            sock.close()
            return False
        sock.setblocking(False)

        def opened() -> None:
            self._begin(self._open(connection, sock, context))
            self._time.charge(host, _HANDSHAKE_SECONDS)

        self._time.run(host, opened)
        return True

    async def _open(
        self, connection: _Connection, sock: socket.socket, context: ssl.SSLContext | None
    ) -> None:
        # The front's deadline also limits the handshake.
        timeouts = {} if context is None else {"ssl_shutdown_timeout": _END_SECONDS}
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: connection, sock, ssl=context, **timeouts
            )
        except OSError:  # the peer disconnected, or does not speak TLS
            connection.leave()
            sock.close()
        except BaseException:
            connection.abort()
            raise
