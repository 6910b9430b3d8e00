"""The inner face: what ROSMaster tells a node is acknowledged, and nothing follows from it."""

import ipaddress
from typing import Any

import pytest

from appliance.master.endpoints.proxy_endpoints import InnerFace
from appliance.master.graph.registry import PUBLISHER_PATH, Kind
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


async def call(face: InnerFace, path: str, method: str, params: tuple[Value, ...]) -> Any:
    """A call of ROSMaster."""
    request = HttpRequest(Peer(MASTER, "127.0.0.1", "127.0.0.1"), path, build_call(method, params), 0)
    return parse_response(await face.handle(request))


@pytest.mark.anyio
@pytest.mark.parametrize(("method", "params"), CALLS)
async def test_what_rosmaster_says_is_told_to_nobody(method: str, params: tuple[Value, ...]) -> None:
    """A key, a value, a publisher or an order that ROSMaster sends reaches no node; ROSMaster is content."""
    world = await ControlParts.begun()
    node = world.node("/robot")
    await world.register(node, Kind.PARAMETER, "/limits/speed", "")
    await world.register(node, Kind.SUBSCRIPTION, "/topic")
    world.deliveries.told.clear()
    face = InnerFace(world.registry)
    for path in (f"/{node.key}/", PUBLISHER_PATH):
        assert await call(face, path, method, params) == [1, "", 0]
    assert not world.deliveries.told


@pytest.mark.anyio
async def test_nobody() -> None:
    """A path that stands for nobody is a fault."""
    with pytest.raises(FaultReceived, match="nobody is here"):
        await call(
            InnerFace((await ControlParts.begun()).registry), "/other/", "shutdown", ("/master", "reason")
        )
