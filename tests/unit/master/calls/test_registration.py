"""Registering and unregistering while the policy changes."""

import asyncio

import pytest

from appliance.master.graph.registry import Kind
from tests.support.control_parts import OPEN, POLICY, ControlParts

pytestmark = pytest.mark.anyio
NO_SECRET = POLICY.format("/secret=\n", "/secret=\n")
URI = "http://10.0.0.5:4001/"
SERVICE_URI = "rosrpc://10.0.0.5:4101"


async def test_a_registration_that_waited_over_a_reload_is_decided_again() -> None:
    """If the new policy does not allow the registration, it is undone."""
    world = await ControlParts.begun()
    world.fill_queue()
    call = asyncio.ensure_future(world.ask("registerPublisher", "/n", "/secret", "std_msgs/String", URI))
    while ("allow", "/secret") not in world.records.events:
        await asyncio.sleep(0)
    world.reload(NO_SECRET)
    await world.round()
    await call
    await world.settle()
    assert [one.resources(Kind.PUBLICATION) for one in world.registry.all() if one.name == "/n"] == [[]]
    assert ("revoked", "/secret") in world.records.events
    assert world.hidden.has(Kind.PUBLICATION, "/secret") == []


async def test_a_service_that_is_looked_up_over_a_reload_is_not_granted() -> None:
    """The answer has the service's port, but no connection to that port is accepted."""
    world = await ControlParts.begun()
    await world.ask("registerService", "/n", "/s", SERVICE_URI, URI)
    world.rosmaster.shut()
    call = asyncio.ensure_future(world.ask("lookupService", "/client", "/s"))
    while world.records.events[-1] != ("allow", "/s"):
        await asyncio.sleep(0)
    world.reload(OPEN + "[Clients]\n")
    await world.round()
    await call
    assert world.grants.all() == []


async def test_a_tool_unregisters_with_the_uris_of_lookups() -> None:
    """On the node's own host, `rosnode cleanup` may unregister the node with the URIs from look-ups."""
    world = await ControlParts.begun()
    await world.ask("registerPublisher", "/n", "/t", "std_msgs/String", URI)
    await world.ask("registerService", "/n", "/s", SERVICE_URI, URI)
    node = world.registry.all()[0]
    await world.ask("unregisterPublisher", "/other", "/t", node.outer_uri("10.0.0.1"))
    assert len(node.registrations) == 2
    await world.ask("unregisterPublisher", "/n", "/t", node.outer_uri("10.0.0.1"))
    await world.ask("unregisterService", "/n", "/s", f"rosrpc://10.0.0.1:{node.relay_port}")
    assert not node.registrations
    assert (world.hidden.has(Kind.PUBLICATION, "/t"), world.hidden.has(Kind.SERVICE, "/s")) == ([], [])


@pytest.mark.nightly
async def test_reading_a_parameter_does_not_wait_for_the_master() -> None:
    """The mirror answers; only a large namespace is fetched from the ROS master."""
    world = await ControlParts.begun()
    await world.ask("setParam", "/n", "/arm/speed", 3)
    before = len(world.hidden.calls)
    assert await world.ask("getParam", "/n", "/arm/speed") == [1, "Parameter [/arm/speed]", 3]
    assert await world.ask("hasParam", "/n", "/arm") == [1, "/arm", True]
    assert await world.ask("hasParam", "/n", "/arm/speed/x") == [1, "/arm/speed/x", False]
    assert await world.ask("getParam", "/n", "/nothing") == [-1, "Parameter [/nothing] is not set", 0]
    assert await world.ask("getParam", "/n", "/arm") == [1, "Parameter [/arm]", {"speed": 3}]
    assert world.hidden.calls[before:] == []
    await world.ask("setParam", "/n", "/leg", {"model": "x" * (1 << 20)})
    before = len(world.hidden.calls)
    await world.ask("getParam", "/n", "/leg")
    assert [call[0] for call in world.hidden.calls[before:]] == ["getParam"]
