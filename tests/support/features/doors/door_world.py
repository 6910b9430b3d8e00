import asyncio
import json
from collections.abc import AsyncIterator, Callable, Collection, Mapping, Sequence
from contextlib import asynccontextmanager
from typing import Any

import cbor2
from websockets.client import ClientProtocol
from websockets.extensions.permessage_deflate import ClientPerMessageDeflateFactory
from websockets.frames import Frame, Opcode
from websockets.http11 import Response
from websockets.protocol import State
from websockets.typing import Origin, Subprotocol
from websockets.uri import parse_uri

from appliance.features.doors.connections import ConnectionLimits, DoorConnections
from appliance.features.doors.door_memory import DoorMemory
from appliance.features.doors.door_node import DoorNode
from appliance.features.doors.foxglove import SUBPROTOCOLS, Foxglove, FoxgloveLimits
from appliance.features.doors.known_types import KnownTypes
from appliance.features.doors.lookout import Lookout
from appliance.features.doors.process import assembled_door
from appliance.features.doors.rosbridge import Rosbridge, RosbridgeLimits
from appliance.features.doors.session import DoorSession, SessionOptions
from appliance.features.doors.values import ValueLimits
from appliance.features.doors.viewer_queue import ViewerQueue
from roswire.node import NodeLimits, RosNode
from roswire.node.network import NodeMemory
from roswire.standard import standard_definitions
from tests.support.autojump import own_tasks
from tests.support.memory_network import MemoryNetwork, MemoryWriter
from tests.support.scripted_master import MASTER, ScriptedMaster

DOOR = ("10.0.0.2", 9090)


class WebSocketClient:
    def __init__(self, reader: asyncio.StreamReader, writer: MemoryWriter, **options: Any) -> None:
        self.reader, self.writer = reader, writer
        self.socket = ClientProtocol(parse_uri("ws://10.0.0.2:9090"), max_size=None, **options)
        self.response: Response | None = None
        self.frames: asyncio.Queue[Any] = asyncio.Queue()
        self._reading = asyncio.ensure_future(self._read())
        self.socket.send_request(self.socket.connect())
        self.flush()

    async def _read(self) -> None:
        while data := await self.reader.read(1 << 16):
            self.socket.receive_data(data)
            for event in self.socket.events_received():
                if isinstance(event, Response):
                    self.response = event
                elif isinstance(event, Frame) and event.opcode is Opcode.TEXT:
                    self.frames.put_nowait(json.loads(bytes(event.data)))
                elif isinstance(event, Frame) and event.opcode is Opcode.BINARY:
                    data = bytes(event.data)
                    self.frames.put_nowait(data if self.socket.subprotocol else cbor2.loads(data))
            self.flush()
        self.socket.receive_eof()

    def flush(self) -> None:
        for data in self.socket.data_to_send():
            if data:
                self.writer.write(data)

    def send(self, frame: "dict[str, Any] | str | bytes") -> None:
        if isinstance(frame, bytes):
            self.socket.send_binary(frame)
        else:
            self.socket.send_text((frame if isinstance(frame, str) else json.dumps(frame)).encode())
        self.flush()

    async def next(self) -> Any:
        async with asyncio.timeout(100):
            return await self.frames.get()

    async def closed(self) -> str:
        await asyncio.wait([self._reading], timeout=1000)
        assert self._reading.done()
        return str(self.socket.close_reason or "")

    def stop_reading(self) -> None:
        self._reading.cancel()

    def read_on(self) -> None:
        self._reading = asyncio.ensure_future(self._read())

    @property
    def is_open(self) -> bool:
        return self.socket.state is State.OPEN


class DoorWorld:
    def __init__(self) -> None:
        self.network = MemoryNetwork()
        self.master = ScriptedMaster(self.network)
        self.limits = ConnectionLimits()
        self.refusals: list[str] = []
        self.memory = DoorMemory()
        self.waiting, self.calls = self.memory.client(), self.memory.client()
        self.memories = [self.waiting, self.calls]
        self.sessions: list[DoorSession] = []
        self.queues: list[ViewerQueue[Any]] = []
        self.rosbridge, self.foxglove = RosbridgeLimits(), FoxgloveLimits()
        self.options = SessionOptions(origins=("https://robot.example",))
        self.types = KnownTypes(standard_definitions(), ValueLimits())
        self.ended: Callable[[DoorSession], None] = lambda _session: None
        self.nodes: list[RosNode] = []
        self.hosts: dict[str, str] = {}  # of nodes
        self.node: RosNode
        self.door: DoorNode
        self.lookout: Lookout

    async def start(self) -> None:
        self.node = await self.robot("10.0.0.2", "/door_alice", self.waiting)
        self.door, self.lookout = assembled_door(
            self.node,
            self.types,
            most_topics=50,
            calls=self.calls,
            hosts=self._hosts_of,
            now=lambda: (7, 8),
        )
        connections = DoorConnections(self.limits)

        async def arrive(reader: asyncio.StreamReader, writer: Any) -> None:
            await connections.serve(
                self.serve, reader, writer, refused=self.refusals.append, host=writer.source
            )

        self.network.listen(DOOR[0], arrive, DOOR[1])

    async def _hosts_of(self, nodes: Collection[str]) -> Mapping[str, str]:
        return {node: self.hosts[node] for node in nodes if node in self.hosts}

    async def robot(self, address: str, name: str, memory: NodeMemory | None = None) -> RosNode:
        node = RosNode(
            name,
            MASTER,
            self.network.at(address),
            limits=NodeLimits(),
            shut_down=lambda _reason: None,
            memory=memory,
        )
        await node.start()
        self.nodes.append(node)
        return node

    async def serve(self, reader: asyncio.StreamReader, writer: Any) -> None:
        memory = self.memory.client(writer.source)
        self.memories.append(memory)
        queue: ViewerQueue[Any] = ViewerQueue(message_bytes=1 << 20, reply_bytes=1 << 20, memory=memory)
        self.queues.append(queue)
        session = DoorSession(
            reader,
            writer,
            door=self.door,
            lookout=self.lookout,
            protocols=lambda name: (
                Rosbridge("/door_alice", self.rosbridge, queue)
                if name is None
                else Foxglove("/door_alice", self.foxglove, queue)
            ),
            subprotocols=SUBPROTOCOLS,
            options=self.options,
            memory=memory,
        )
        self.sessions.append(session)
        await session.run()
        self.ended(session)

    async def client(
        self,
        host: str = "10.0.0.9",
        *,
        origin: str | None = None,
        subprotocols: Sequence[str] = (),
        deflate: bool = False,
    ) -> WebSocketClient:
        client = WebSocketClient(
            *self.network.connect(host, DOOR),
            origin=None if origin is None else Origin(origin),
            subprotocols=[*map(Subprotocol, subprotocols)] or None,
            extensions=[ClientPerMessageDeflateFactory()] if deflate else None,
        )
        await asyncio.sleep(0.1)
        return client


@asynccontextmanager
async def door_world() -> AsyncIterator[DoorWorld]:
    """Yield a door and its surroundings. At the end, no task of them may remain, and no memory may be held."""
    world = DoorWorld()
    await world.start()
    try:
        yield world
    finally:
        world.network.break_off(DOOR)
        await asyncio.sleep(5)
        await world.door.close()
        for node in world.nodes:
            await node.close()
        await asyncio.sleep(1)
        assert not own_tasks()
        assert not any(memory.held for memory in world.memories)
