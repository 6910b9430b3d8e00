import ipaddress

import pytest

from appliance.master.graph.registry import Kind
from tests.support.control_parts import HOST, ControlParts

pytestmark = pytest.mark.anyio


async def test_a_call_that_was_allowed_before_another_host_took_the_name_gives_no_grant() -> None:
    world, other = await ControlParts.begun(), ipaddress.ip_address("10.0.0.66")
    server = world.node("/server")
    await world.register(server, Kind.PUBLICATION, "/t")
    await world.register(world.node("/ear", 2, other), Kind.SUBSCRIPTION, "/t")
    for host in (HOST, other):
        world.graph.topic_granted(server, "/t", host, "/ear")
        world.graph.service_granted(server, "/s", host, "/ear")
        world.graph.topic_granted(server, "/t", host, "/unregistered")
    assert [(row.host, row.caller_id) for row in world.grants.of(server.key)] == [
        (str(HOST), "/unregistered"), *[(str(other), "/ear")] * 2, (str(other), "/unregistered"),
    ]  # fmt: skip
