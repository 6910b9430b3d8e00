"""A network in memory for nodes in virtual time, whose connections keep the order and have bounded buffers."""

import asyncio
from dataclasses import dataclass, field

from roswire.node.network import ByteWriter, Serve
from roswire.tcpros import Body

_ROOM = 1 << 16  # bytes after which a reader pauses its peer, twice


class MemoryNetwork:
    def __init__(self) -> None:
        self.servers: dict[tuple[str, int], Serve] = {}
        self.connections: list[tuple[str, tuple[str, int]]] = []  # source, target
        self._port = 40_000
        self._tasks: set[asyncio.Task[None]] = set()
        self._open: list[MemoryWriter] = []

    def at(self, source: str) -> "MemoryHost":
        return MemoryHost(self, source)

    def listen(self, host: str, serve: Serve, port: int = 0) -> "MemoryServer":
        self._port += 1
        server = MemoryServer(self, (host, port or self._port))
        self.servers[server.address] = serve
        return server

    def connect(self, source: str, address: tuple[str, int]) -> "tuple[asyncio.StreamReader, MemoryWriter]":
        if address not in self.servers:
            raise ConnectionRefusedError(111, "Connection refused")
        self.connections.append((source, address))
        near, far = MemoryWriter(address), MemoryWriter(address, source)
        near.peer, far.peer = far, near
        self._open += near, far
        task = asyncio.ensure_future(self._serve(self.servers[address], far))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return near.reader, near

    def feed(self, source: str, address: tuple[str, int], receiver: asyncio.BufferedProtocol) -> None:
        reader, writer = self.connect(source, address)
        task = asyncio.ensure_future(_Transport(reader, writer).feed(receiver))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, serve: Serve, end: "MemoryWriter") -> None:
        await serve(end.reader, end)

    def break_off(self, address: tuple[str, int]) -> None:
        for end in self._open:
            if end.address == address:
                end.close()


@dataclass
class MemoryHost:
    network: MemoryNetwork
    source: str

    async def connect(self, host: str, port: int) -> tuple[asyncio.StreamReader, ByteWriter]:
        await asyncio.sleep(0)
        return self.network.connect(self.source, (host, port))

    async def receive(self, host: str, port: int, receiver: asyncio.BufferedProtocol) -> None:
        await asyncio.sleep(0)
        self.network.feed(self.source, (host, port), receiver)
        await asyncio.sleep(0)

    async def serve(self, serve: Serve) -> "MemoryServer":
        return self.network.listen(self.source, serve)


@dataclass
class MemoryServer:
    network: MemoryNetwork
    address: tuple[str, int]

    @property
    def port(self) -> int:
        return self.address[1]

    def close(self) -> None:
        self.network.servers.pop(self.address, None)


class _Transport(asyncio.Transport):
    def __init__(self, reader: asyncio.StreamReader, writer: "MemoryWriter") -> None:
        super().__init__()
        self._reader, self._writer = reader, writer
        self._reading = asyncio.Event()
        self._reading.set()

    async def feed(self, receiver: asyncio.BufferedProtocol) -> None:
        receiver.connection_made(self)
        while True:
            await self._reading.wait()
            data = await self._reader.read(len(memoryview(receiver.get_buffer(-1))))
            if not data:
                receiver.connection_lost(None)
                return
            memoryview(receiver.get_buffer(-1))[: len(data)] = data
            receiver.buffer_updated(len(data))

    def pause_reading(self) -> None:
        self._reading.clear()

    def resume_reading(self) -> None:
        self._reading.set()

    def write(self, data: bytes | bytearray | memoryview) -> None:
        self._writer.write(bytes(data))

    def close(self) -> None:
        self._reading.set()
        self._writer.close()


class _Reader(asyncio.StreamReader):
    _buffer: bytearray

    @property
    def unread(self) -> int:
        return len(self._buffer)

    def discard(self) -> bool:
        unread = bool(self._buffer)
        self._buffer.clear()
        return unread


@dataclass(eq=False)
class MemoryWriter:
    address: tuple[str, int]
    source: str = ""  # of the peer
    closed: bool = False
    reader: _Reader = field(init=False)
    peer: "MemoryWriter" = field(init=False)

    def __post_init__(self) -> None:
        self.reader = _Reader(limit=_ROOM)
        self.reader.set_transport(self)  # type: ignore[arg-type]  # a reader only pauses and resumes it
        self.has_room = asyncio.Event()
        self.has_room.set()

    def write(self, data: Body) -> None:
        if not self.closed and not self.peer.closed:
            self.peer.reader.feed_data(data)

    async def drain(self) -> None:
        await self.peer.has_room.wait()
        if self.closed or self.peer.closed:
            raise ConnectionResetError("the connection ended")

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self.has_room.set()
            if self.reader.discard():  # as with TCP, unread bytes reset the connection
                self.peer.reader.discard()
            for end in (self, self.peer):
                if not end.reader.at_eof():
                    end.reader.feed_eof()

    @property
    def unsent(self) -> int:
        return 0 if self.peer.has_room.is_set() else self.peer.reader.unread

    def abort(self) -> None:
        self.peer.reader.discard()
        self.close()

    def pause_reading(self) -> None:
        self.has_room.clear()

    def resume_reading(self) -> None:
        self.has_room.set()

    def is_closing(self) -> bool:
        return self.closed
