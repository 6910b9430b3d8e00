"""The network of a door's node, which gets each socket from control (`door_link.py`)."""

import asyncio
import os
import socket
from collections.abc import Callable

from appliance.features.doors.door_link import SocketWanted
from roswire.node.network import BUFFER_BYTES, ByteWriter, ListeningServer, Serve

_SECONDS = 10.0


class PassedSockets:
    """A `NodeNetwork` with sockets from control. `ask(message)` sends a request, and returns False without a link."""

    def __init__(self, source: str, ask: Callable[[SocketWanted], bool]) -> None:
        self.source = source
        self._ask = ask
        self._waiting: dict[int, asyncio.Future[socket.socket]] = {}
        self._number = 0

    async def connect(self, host: str, port: int) -> tuple[asyncio.StreamReader, ByteWriter]:
        """Return a connection to a port of the appliance; `host` is ignored."""
        del host
        connection = await self._socket(port)
        return await asyncio.open_connection(sock=connection, limit=BUFFER_BYTES)

    async def receive(self, host: str, port: int, receiver: asyncio.BufferedProtocol) -> None:
        del host
        connection = await self._socket(port)
        await asyncio.get_running_loop().create_connection(lambda: receiver, sock=connection)

    async def serve(self, serve: Serve) -> ListeningServer:
        listener = await self._socket(0)
        return _Server(await asyncio.start_server(serve, sock=listener, limit=BUFFER_BYTES))

    async def _socket(self, port: int) -> socket.socket:
        self._number += 1
        number = self._number
        future = self._waiting[number] = asyncio.get_running_loop().create_future()
        try:
            if not self._ask(SocketWanted(number, port)):
                raise ConnectionRefusedError("the appliance is being restarted")
            async with asyncio.timeout(_SECONDS):
                made: socket.socket = await future
                return made
        finally:
            del self._waiting[number]

    def given(self, number: int, descriptor: int) -> None:
        future = self._waiting.get(number)
        if future is None or future.done():
            os.close(descriptor)
            return
        made = socket.socket(fileno=descriptor)
        made.setblocking(False)
        future.set_result(made)

    def refused(self, number: int, reason: str) -> None:
        future = self._waiting.get(number)
        if future is not None and not future.done():
            future.set_exception(ConnectionRefusedError(reason))

    def lost(self) -> None:
        for number in [*self._waiting]:
            self.refused(number, "the appliance is being restarted")


class _Server:
    def __init__(self, server: asyncio.Server) -> None:
        self._server = server
        self.port = int(server.sockets[0].getsockname()[1])

    def close(self) -> None:
        self._server.close()
