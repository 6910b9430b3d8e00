"""A door on real sockets. Run the module with MASTER_URI ADDRESS PORT [FILE.srv …], and it serves until it is killed.

As in the door process, another part listens, and passes each connection on as a descriptor.
"""

import asyncio
import os
import socket
import sys
from collections.abc import AsyncIterator, Collection, Mapping
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path

from appliance.features.doors.connections import ClientWriter, ConnectionLimits, DoorConnections, ServeClient
from appliance.features.doors.door_memory import ClientMemory, DoorMemory
from appliance.features.doors.foxglove import SUBPROTOCOLS, Foxglove, FoxgloveLimits
from appliance.features.doors.known_types import KnownTypes
from appliance.features.doors.process import assembled_door
from appliance.features.doors.rosbridge import Rosbridge, RosbridgeLimits
from appliance.features.doors.session import ClientProtocol, DoorSession, SessionOptions
from appliance.features.doors.values import ValueLimits
from appliance.features.doors.viewer_queue import ViewerQueue
from roswire.definitions import Definitions
from roswire.node import NodeLimits, RosNode, SourceNetwork
from roswire.standard import standard_definitions

NAME = "/door"


def protocol_of(memory: ClientMemory, subprotocol: str | None) -> ClientProtocol:
    if subprotocol is None:
        return Rosbridge(NAME, RosbridgeLimits(), ViewerQueue(memory=memory))
    return Foxglove(NAME, FoxgloveLimits(), ViewerQueue(memory=memory))


@asynccontextmanager
async def real_door(
    master_uri: str, source: str, port: int = 0, definitions: Definitions | None = None
) -> AsyncIterator[int]:
    node = RosNode(
        NAME, master_uri, SourceNetwork(source), limits=NodeLimits(), shut_down=lambda _reason: None
    )
    await node.start()
    defined = standard_definitions()
    types = KnownTypes(defined.merge(definitions) if definitions else defined, ValueLimits())
    door, lookout = assembled_door(
        node, types, most_topics=2000, calls=DoorMemory().client(), hosts=_no_hosts
    )

    async def serve(reader: asyncio.StreamReader, writer: ClientWriter) -> None:
        memory = DoorMemory().client()
        await DoorSession(
            reader,
            writer,
            door=door,
            lookout=lookout,
            protocols=partial(protocol_of, memory),
            subprotocols=SUBPROTOCOLS,
            options=SessionOptions(),
            memory=memory,
        ).run()

    connections = DoorConnections(ConnectionLimits())
    with socket.create_server((source, port)) as listener:
        listener.setblocking(False)
        accepting = asyncio.ensure_future(_accept(listener, connections, serve))
        try:
            yield listener.getsockname()[1]
        finally:
            accepting.cancel()
            await connections.close()
            await door.close()


async def _no_hosts(_nodes: Collection[str]) -> Mapping[str, str]:
    return {}


async def _accept(listener: socket.socket, connections: DoorConnections, serve: ServeClient) -> None:
    while True:
        connection, _address = await asyncio.get_running_loop().sock_accept(listener)
        with connection:
            connections.adopt(os.dup(connection.fileno()), serve, lambda _reason: None, host="")


async def main(master_uri: str, source: str, port: str, *files: str) -> None:
    texts = {"/".join(Path(file).parts[-2:]): Path(file).read_text(encoding="utf-8") for file in files}
    async with real_door(master_uri, source, int(port), Definitions.from_files(texts)):
        await asyncio.get_running_loop().create_future()


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
