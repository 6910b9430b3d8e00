import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

from appliance.features.doors import door_link, process
from appliance.features.doors.connections import DoorConnections
from appliance.features.doors.process import DoorProcess
from roswire.node.network import OwnedTasks
from tests.support.features.doors.door_world import WebSocketClient
from tests.support.memory_network import MemoryNetwork

pytestmark = pytest.mark.anyio
SLOTS = 32
GIVEN = door_link.DoorGiven("alice", 1.0, "10.0.0.2", 11311, [], SLOTS, 200, ["ticket"])


@pytest.mark.parametrize(("hosts", "most"), [(1, 24), (100, SLOTS)])
async def test_viewers_that_wait_for_the_node_are_bounded_like_connections(
    monkeypatch: pytest.MonkeyPatch, hosts: int, most: int
) -> None:
    """Each has a valid ticket. Those beyond the limits get the reason before the node has started."""
    network, arrived = MemoryNetwork(), asyncio.Queue[Any]()
    network.listen("10.0.0.2", lambda *streams: arrived.put(streams), 9090)

    def adopt(connections: DoorConnections, _descriptor: int, serve: Any, refused: Any, *, host: str) -> None:
        reader, writer = arrived.get_nowait()
        tasks.append(
            asyncio.ensure_future(connections.serve(serve, reader, writer, refused=refused, host=host))
        )

    async def waits(*_given: Any) -> None:
        await asyncio.sleep(3600)

    tasks: list[asyncio.Future[None]] = []
    orders: dict[str, Any] = {}

    def child(*_wires: Any, **calls: Any) -> SimpleNamespace:
        orders.update(calls)
        return SimpleNamespace(tell=lambda _message: True)

    owned = OwnedTasks()
    monkeypatch.setattr(process, "OwnedTasks", lambda: owned)
    monkeypatch.setattr(process, "Child", child)
    monkeypatch.setattr(process, "Channel", lambda *_wires: None)
    monkeypatch.setattr(process, "socket", SimpleNamespace(socket=lambda **_of: None))
    monkeypatch.setattr(DoorProcess, "_start", waits)
    monkeypatch.setattr(DoorConnections, "adopt", adopt)
    DoorProcess(0)
    orders["said"](GIVEN)
    clients = []
    for number in range(100):
        host = f"10.0.1.{number % hosts}"
        clients.append(WebSocketClient(*network.connect(host, ("10.0.0.2", 9090))))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        orders["took"](door_link.ViewerGiven(host, "ticket"), (3,))
    await asyncio.sleep(1)
    refused = [client.response for client in clients if client.response is not None]
    assert [one.status_code for one in refused] == [503] * (100 - most)
    assert sum(not task.done() for task in tasks) == most
    for task in tasks:
        task.cancel()
    await owned.close()
