"""TCP with one source address, and the tasks and errors of a node.

Every connection leaves from the source address, and servers listen only there, so peers can identify the node by it.
"""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from typing import Protocol

from roswire.errors import RosError
from roswire.tcpros import Body

BUFFER_BYTES = 1 << 19


class NodeCallError(RosError):
    """A call of the master, a node or a service has no usable result. The message names the call and the reason."""


class PeerUnreachableError(NodeCallError):
    """The peer cannot be reached, broke the connection, or did not answer in time."""


class MasterDenialError(NodeCallError):
    """The master denied a call, with this text."""


class ServiceFailedError(NodeCallError):
    """A service failed, with this text."""


class ByteWriter(Protocol):
    """The part of `asyncio.StreamWriter` that a node uses."""

    def write(self, data: Body) -> None: ...

    async def drain(self) -> None:
        """Wait until the peer has read enough. Raise `OSError` if the connection has ended."""

    def close(self) -> None: ...


Serve = Callable[[asyncio.StreamReader, ByteWriter], Awaitable[None]]


class NodeMemory(Protocol):
    """A budget of bytes, which several nodes may share."""

    def add(self, size: int) -> None:
        """Take bytes from the budget, or return them if `size` is negative."""

    def refusal(self, size: int) -> str:
        """Return the reason why `size` more bytes would exceed the budget, or ""."""


class ListeningServer(Protocol):
    """A server that listens at the source address."""

    @property
    def port(self) -> int: ...
    def close(self) -> None: ...


class NodeNetwork(Protocol):
    """The operations of a network that a node uses. They raise `OSError`."""

    @property
    def source(self) -> str: ...

    async def connect(self, host: str, port: int) -> tuple[asyncio.StreamReader, ByteWriter]:
        """Connect from the source address."""

    async def receive(self, host: str, port: int, receiver: asyncio.BufferedProtocol) -> None:
        """Connect from the source address, and give the peer's bytes to `receiver`."""

    async def serve(self, serve: Serve) -> ListeningServer:
        """Listen on a free port of the source address."""


class SourceNetwork:
    """Open connections and listeners from one local address."""

    def __init__(self, source: str) -> None:
        self.source = source

    async def connect(self, host: str, port: int) -> tuple[asyncio.StreamReader, ByteWriter]:
        return await asyncio.open_connection(host, port, local_addr=(self.source, 0), limit=BUFFER_BYTES)

    async def receive(self, host: str, port: int, receiver: asyncio.BufferedProtocol) -> None:
        loop = asyncio.get_running_loop()
        await loop.create_connection(lambda: receiver, host, port, local_addr=(self.source, 0))

    async def serve(self, serve: Serve) -> ListeningServer:
        server = await asyncio.start_server(serve, self.source, 0, limit=BUFFER_BYTES)
        return _AsyncioServer(server)


class _AsyncioServer:
    def __init__(self, server: asyncio.Server) -> None:
        self._server = server
        self.port = int(server.sockets[0].getsockname()[1])

    def close(self) -> None:
        self._server.close()


class OwnedTasks:
    """Tasks that end with their owner."""

    def __init__(self) -> None:
        self._tasks: set[asyncio.Task[None]] = set()

    def __len__(self) -> int:
        return len(self._tasks)

    def start(self, work: Coroutine[None, None, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    def own_current(self) -> None:
        task = asyncio.current_task()
        if task is not None:
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def close(self) -> None:
        tasks = [task for task in self._tasks if task is not asyncio.current_task()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
