"""Carry the replication over TLS 1.3: the active appliance listens, the standby connects."""

import asyncio
import socket
import ssl
from typing import Protocol

import structlog

from appliance.features.standby.replication_frames import ReplicationError
from appliance.features.standby.replication_receiver import ReplicationReceiver

_HANDSHAKE_SECONDS = 5.0
_PAUSE_SECONDS = 1.0
_MOST_CONNECTIONS = 8  # one is in use; others are in their handshake, or replace it

_log = structlog.get_logger()


class _Server(Protocol):
    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None: ...


class ReplicationListener:
    """Accepts the other appliance's connections."""

    def __init__(self, server: _Server, context: ssl.SSLContext) -> None:
        self._server = server
        self._context = context
        self._connections: set[asyncio.Task[None]] = set()

    async def run(self, listening: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        listening.setblocking(False)
        try:
            while True:
                try:
                    connection, _address = await loop.sock_accept(listening)
                except OSError as error:  # such as too many open files
                    _log.warning("a connection for replication was not accepted", error=str(error))
                    await asyncio.sleep(_PAUSE_SECONDS)
                    continue
                if len(self._connections) >= _MOST_CONNECTIONS:
                    connection.close()
                    continue
                task = loop.create_task(self._serve(connection))
                self._connections.add(task)
                task.add_done_callback(self._connections.discard)
        finally:
            for task in self._connections:
                task.cancel()
            await asyncio.gather(*self._connections, return_exceptions=True)

    async def _serve(self, connection: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        reader = asyncio.StreamReader()
        protocol = asyncio.StreamReaderProtocol(reader)
        try:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # asyncio omits it here
            transport, _ = await loop.connect_accepted_socket(
                lambda: protocol, connection, ssl=self._context, ssl_handshake_timeout=_HANDSHAKE_SECONDS
            )
        except OSError as error:
            connection.close()
            _log.warning("a connection for replication was refused", error=str(error))
            return
        writer = asyncio.StreamWriter(transport, protocol, reader, loop)
        try:
            await self._server.serve(reader, writer)
        except ReplicationError as error:
            _log.warning("the replication to the standby ended", reason=str(error))


async def follow_at(address: str, port: int, context: ssl.SSLContext, receiver: ReplicationReceiver) -> None:
    try:
        async with asyncio.timeout(2 * _HANDSHAKE_SECONDS):
            reader, writer = await asyncio.open_connection(
                address, port, ssl=context, ssl_handshake_timeout=_HANDSHAKE_SECONDS
            )
    except (OSError, TimeoutError) as error:
        raise ReplicationError(f"{address}:{port} does not answer: {error}") from error
    await receiver.follow(reader, writer)
