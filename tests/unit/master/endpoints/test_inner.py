import ipaddress
from typing import Any

import pytest

from appliance.master.graph.registry import PUBLISHER_PATH, Kind
from appliance.master.reconcile.sinks import MasterSideApi
from appliance.rpc.server import HttpRequest, Peer
from roswire.xmlrpc import FaultReceived, Value, build_call, parse_response
from tests.support.control_parts import ControlParts

MASTER = ipaddress.ip_address("127.0.0.1")
CALLS: list[tuple[str, tuple[Value, ...]]] = [
    ("paramUpdate", ("/master", "/limits/speed/", 666)),
    ("publisherUpdate", ("/master", "/topic", ["http://10.0.0.66:1/"])),
    ("shutdown", ("/master", "another has the name")),
    ("requestTopic", ("/master", "/topic", [["TCPROS"]])),
    ("getPid", ("/master",)),
]


async def call(face: MasterSideApi, path: str, method: str, params: tuple[Value, ...]) -> Any:
    request = HttpRequest(Peer(MASTER, "127.0.0.1", "127.0.0.1"), path, build_call(method, params), 0)
    return parse_response(await face.handle(request))


@pytest.mark.anyio
@pytest.mark.parametrize(("method", "params"), CALLS)
async def test_calls_of_rosmaster_reach_no_node(method: str, params: tuple[Value, ...]) -> None:
    world = await ControlParts.begun()
    node = world.node("/robot")
    await world.register(node, Kind.PARAMETER, "/limits/speed", "")
    await world.register(node, Kind.SUBSCRIPTION, "/topic")
    world.deliveries.told.clear()
    face = MasterSideApi(world.registry)
    for path in (f"/{node.key}/", PUBLISHER_PATH):
        assert await call(face, path, method, params) == [1, "", 0]
    assert not world.deliveries.told


@pytest.mark.anyio
async def test_a_path_without_a_node() -> None:
    with pytest.raises(FaultReceived, match="this address serves no calls"):
        await call(
            MasterSideApi((await ControlParts.begun()).registry), "/other/", "shutdown", ("/master", "reason")
        )
