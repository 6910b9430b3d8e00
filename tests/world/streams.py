"""Connections of bytes, and datagrams, between machines: the replication, and the messages of the lease.

While two machines are cut off from each other, the bytes of a connection wait, because TCP sends them again, and
datagrams are lost.
"""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Any

from tests.world.loop import Process, present_process
from tests.world.network import Address, Network

_SECONDS = (0.0, 0.001, 0.005, 0.05)
_FIRST_FREE_PORT = 50_000
_AGAIN_SECONDS = 0.1
Serve = Callable[[Any, Any], Awaitable[None]]


class StreamEnd:
    def __init__(self, network: Network, process: Process) -> None:
        self.reader = asyncio.StreamReader(loop=process.machine.loop)
        self.transport = self
        self.other: StreamEnd
        self._network = network
        self.process = process
        self._sent: deque[bytes] = deque()
        self.closed = False
        process.ends.append(self.abort)

    def write(self, data: bytes) -> None:
        if self.closed:
            return
        self._sent.append(data)
        if len(self._sent) == 1:
            self._later(self._deliver)

    async def drain(self) -> None:
        if self.closed or self.other.closed:
            raise ConnectionResetError("the connection ended")
        await asyncio.sleep(0)

    def abort(self) -> None:
        if not self.closed:
            self.closed = True
            self._sent.append(b"")
            if len(self._sent) == 1:
                self._later(self._deliver)

    async def wait_closed(self) -> None: ...

    def _later(self, act: Callable[[], None]) -> None:
        loop = self.process.machine.loop
        loop.outside.call(loop.random.choice(_SECONDS), act)

    def _deliver(self) -> None:
        ends = self.process.machine.name, self.other.process.machine.name
        if frozenset(ends) in self._network.cut:
            self.process.machine.loop.outside.call(_AGAIN_SECONDS, self._deliver)
            return
        data = self._sent.popleft()
        self.other.take(data)
        if self._sent:
            self._later(self._deliver)

    def take(self, data: bytes) -> None:
        if self.process.alive and not self.reader.at_eof():
            self.process.run(self.reader.feed_data if data else self._eof, data)

    def _eof(self, _data: bytes) -> None:
        self.reader.feed_eof()


class Streams:
    def __init__(self, network: Network) -> None:
        self._network = network
        self._servers: dict[Address, tuple[Process, Serve]] = {}
        self._sockets: dict[Address, DatagramSocket] = {}

    async def serve(self, port: int, serve: Serve) -> None:
        process = present_process()
        address, served = (process.machine.name, port), (process, serve)
        self._servers[address] = served
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            if self._servers.get(address) is served:
                del self._servers[address]

    async def connect(self, address: str, port: int) -> StreamEnd:
        process = present_process()
        await asyncio.sleep(process.machine.loop.random.choice(_SECONDS))
        served = self._servers.get((address, port))
        cut = frozenset((address, process.machine.name)) in self._network.cut
        if cut or served is None or not served[0].alive:
            raise ConnectionRefusedError(111, "Connection refused")
        end, other = StreamEnd(self._network, process), StreamEnd(self._network, served[0])
        end.other, other.other = other, end
        served[0].start(_served(served[1], other))
        return end

    def socket(self, *kind: Any, fileno: Any = None) -> Any:
        return DatagramSocket(self) if kind else fileno

    def free_port(self) -> int:
        return _FIRST_FREE_PORT + len(self._sockets)

    def bind(self, address: Address, sock: "DatagramSocket") -> None:
        self._sockets[address] = sock

    def send(self, data: bytes, source: Address, target: Address) -> None:
        loop = self._network.loop
        if frozenset((source[0], target[0])) not in self._network.cut:
            loop.outside.call(loop.random.choice(_SECONDS), self._arrive, data, source, target)

    def _arrive(self, data: bytes, source: Address, target: Address) -> None:
        sock = self._sockets.get(target)
        if sock is not None and sock.process.alive:
            sock.process.call(0.0, sock.take, data, source)


async def _served(serve: Serve, end: StreamEnd) -> None:
    await serve(end.reader, end)


class DatagramSocket:
    def __init__(self, streams: Streams) -> None:
        self.process = present_process()
        self.readable: Callable[[], None] = lambda: None
        self._streams = streams
        self._waiting: deque[tuple[bytes, Address]] = deque()
        self._address: Address = (self.process.machine.name, 0)

    def setblocking(self, _blocking: bool) -> None:
        """No call blocks."""

    def bind(self, address: Address) -> None:
        self._address = self.process.machine.name, address[1]
        self._streams.bind(self._address, self)

    def fileno(self) -> "DatagramSocket":
        return self

    def sendto(self, data: bytes, target: Address) -> None:
        if not self._address[1]:
            self.bind((self.process.machine.name, self._streams.free_port()))
        self._streams.send(data, self._address, target)

    def recvfrom(self, _size: int) -> tuple[bytes, Address]:
        if not self._waiting:
            raise BlockingIOError
        return self._waiting.popleft()

    def take(self, data: bytes, source: Address) -> None:
        self._waiting.append((data, source))
        self.readable()

    def close(self) -> None: ...
