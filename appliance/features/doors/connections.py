"""Serve the connections of one door, which arrive as descriptors, and limit their number and rate.

Agents normally make a connection for each call; a client that connects in a loop is limited. Beyond its first
connection, a host gets only a part of the present and of the new ones (`host_shares.py`).
"""

import asyncio
import socket
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from http import HTTPStatus
from typing import Protocol

from appliance.features.doors.host_shares import of_hosts
from roswire.node.network import BUFFER_BYTES, ByteWriter, OwnedTasks


class ClientWriter(ByteWriter, Protocol):
    """The writer of a client's connection."""

    @property
    def unsent(self) -> int:
        """The bytes that wait in this process until the client takes more."""

    def abort(self) -> None:
        """Close the connection, and drop the unsent bytes."""


ServeClient = Callable[[asyncio.StreamReader, ClientWriter], Awaitable[None]]

_REFUSAL_SECONDS = 5.0
_MAX_REFUSALS = 64  # at the same time; further connections end without words


@dataclass(frozen=True, slots=True)
class ConnectionLimits:
    """Upper bounds for all clients of one door."""

    connections: int = 32  # at the same time
    in_ten_seconds: int = 200  # new ones


class DoorConnections:
    """Serves connections within the limits. `refused` counts the connections beyond them."""

    def __init__(self, limits: ConnectionLimits) -> None:
        self.refused = 0
        self._open = of_hosts("connections of this door", limits.connections)
        self._new = of_hosts("new connections of this door in ten seconds", limits.in_ten_seconds)
        self._refusing = of_hosts("refusals of this door", _MAX_REFUSALS)
        self._recent: deque[tuple[float, str]] = deque()
        self._tasks = OwnedTasks()

    def adopt(
        self, descriptor: int, serve: ServeClient, refused: Callable[[str], None], *, host: str
    ) -> None:
        self._tasks.start(self._adopt(socket.socket(fileno=descriptor), serve, refused, host))

    async def _adopt(
        self, connection: socket.socket, serve: ServeClient, refused: Callable[[str], None], host: str
    ) -> None:
        connection.setblocking(False)
        local = connection.family == socket.AF_UNIX
        opening = asyncio.open_unix_connection if local else asyncio.open_connection
        reader, writer = await opening(sock=connection, limit=BUFFER_BYTES)
        await self.serve(serve, reader, _StreamWriter(writer), refused=refused, host=host)

    async def serve(
        self,
        serve: ServeClient,
        reader: asyncio.StreamReader,
        writer: ClientWriter,
        *,
        refused: Callable[[str], None],
        host: str,
    ) -> None:
        reason = self._excess(host)
        if reason:
            refused(reason)
            await self._refuse(reader, writer, reason, host)
            return
        self._open.charge(host)
        try:
            await serve(reader, writer)
        finally:
            self._open.give_back(host)

    def _excess(self, host: str) -> str:
        now = asyncio.get_running_loop().time()
        while self._recent and self._recent[0][0] <= now - 10:
            self._new.give_back(self._recent.popleft()[1])
        reason = self._open.refusal(host) or self._new.take(host)
        if not reason:
            self._recent.append((now, host))
        return reason

    async def _refuse(self, reader: asyncio.StreamReader, writer: ByteWriter, reason: str, host: str) -> None:
        self.refused += 1
        if self._refusing.take(host):
            writer.close()
            return
        try:
            async with asyncio.timeout(_REFUSAL_SECONDS):
                # If bytes were unread at the end, the client would get a reset instead of the answer.
                await reader.readuntil(b"\r\n\r\n")
                writer.write(_refusal(reason))
                await writer.drain()
        except (OSError, EOFError, asyncio.LimitOverrunError):  # the client sent no request, or left
            return
        finally:
            self._refusing.give_back(host)
            writer.close()

    async def close(self) -> None:
        await self._tasks.close()


class _StreamWriter:
    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self._transport = writer.transport
        self.write, self.drain, self.close = writer.write, writer.drain, writer.close

    @property
    def unsent(self) -> int:
        return self._transport.get_write_buffer_size()

    def abort(self) -> None:
        self._transport.abort()


def _refusal(reason: str) -> bytes:
    status = HTTPStatus.SERVICE_UNAVAILABLE
    body = f"{reason}\n".encode()
    head = (
        f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Type: text/plain; charset=utf-8\r\n"
        f"Content-Length: {len(body)}\r\nRetry-After: 10\r\nConnection: close\r\n\r\n"
    )
    return head.encode() + body
