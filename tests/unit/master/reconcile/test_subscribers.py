"""Nodes get the lists that they missed because control died during a change, or because they were disconnected."""

import ipaddress

import pytest

from appliance.master.graph.registry import Kind, Life
from appliance.store.state_file import PermissionRow
from roswire.xmlrpc import Value
from tests.support.control_parts import HOST, POLICY, ControlParts

pytestmark = pytest.mark.anyio


async def test_the_next_control_repeats_the_news_of_a_lost_topic() -> None:
    world = await ControlParts.begun()
    node = world.node("/ear")
    await world.register(node, Kind.SUBSCRIPTION, "/secret")
    await world.register(node, Kind.SUBSCRIPTION, "/plain")
    world.reload(POLICY.format("", "/secret=\n"))
    world.deliveries.told.clear()
    world.subscribers.remind_all()
    emptied: tuple[str, str, tuple[Value, ...]] = ("/ear", "publisherUpdate", ("/secret", []))
    assert emptied in world.deliveries.told
    world.deliveries.told.clear()
    world.subscribers.remind_all(lambda topic: topic == "/plain")
    assert [params[0] for _name, _method, params in world.deliveries.told] == ["/plain"]


async def test_subscribers_without_a_connection_are_absent() -> None:
    world = await ControlParts.begun()
    talker, ear, other = world.node("/talker", 1), world.node("/ear", 2), world.node("/other", 3)
    await world.register(talker, Kind.PUBLICATION, "/a")
    for node in (talker, ear, other):
        await world.register(node, Kind.SUBSCRIPTION, "/a")
    connected = PermissionRow(talker.key, "topic", "/a", str(HOST), "/other")
    world.grants.used = lambda: {connected}
    assert list(world.subscribers.absent(world.registry.live())) == [(ear, "/a", [talker])]
    assert list(world.subscribers.absent([other])) == []


async def test_no_subscriber_is_absent_without_the_relay() -> None:
    world = await ControlParts.begun()
    world.relay.relay_all = False
    talker, ear, own = world.node("/talker", 1), world.node("/ear", 2), world.node("/rosout", 3)
    own.own = True
    await world.register(talker, Kind.PUBLICATION, "/a")
    for node in (ear, own):
        await world.register(node, Kind.SUBSCRIPTION, "/a")
    assert list(world.subscribers.absent(world.registry.live())) == [(own, "/a", [talker])]


@pytest.mark.parametrize("other_host", [False, True])
@pytest.mark.parametrize("other_uri", [False, True])
async def test_a_replaced_node_is_shut_down_as_by_the_ros_master(other_host: bool, other_uri: bool) -> None:
    """A laptop on Wi-Fi gets a cable, so the same node calls from another address, with the same URI."""
    world = await ControlParts.begun()
    first = world.node("/n", 1)
    second = world.node("/n", 2, ipaddress.ip_address("10.0.0.6") if other_host else HOST)
    if not other_uri:
        second.api_text = first.api_text
    await world.register(first, Kind.SUBSCRIPTION, "/a")
    await world.register(second, Kind.SUBSCRIPTION, "/b")
    assert first.life is Life.REPLACED
    told = [method for _name, method, _params in world.deliveries.told]
    assert ("shutdown" in told) == other_uri
