"""What the graph tells and takes when lives of one name overlap, and when control has died over a change."""

from typing import Any, cast

import pytest

from appliance.master.graph.registry import Kind, Life
from appliance.store.state_file import PermissionRow
from roswire.xmlrpc import Value
from tests.support.control_parts import HOST, POLICY, ControlParts

pytestmark = pytest.mark.anyio


@pytest.mark.parametrize("forgotten", [False, True], ids=["it unregisters", "it is forgotten"])
async def test_a_lost_life_takes_nothing_from_the_one_that_has_its_name(forgotten: bool) -> None:
    """It hung, another was started, and it wakes up to shut down: the grant of both, by name and host, stands."""
    world = await ControlParts.begun()
    talker, old, new = world.node("/talker"), world.node("/ear", 2), world.node("/ear", 3)
    await world.register(talker, Kind.PUBLICATION, "/a")
    await world.register(old, Kind.SUBSCRIPTION, "/a")
    world.clients.silent = {"/ear"}
    await world.look(old)
    assert old.life is Life.SHADOW
    await world.register(new, Kind.SUBSCRIPTION, "/a")
    grant = PermissionRow(talker.key, "topic", "/a", str(HOST), "/ear")
    world.enactor.carry_out(world.graph.topic_granted(talker, "/a", HOST, "/ear"))
    gone = world.graph.forgotten(old) if forgotten else world.graph.unregistered(old, Kind.SUBSCRIPTION, "/a")
    world.enactor.carry_out(gone)
    assert list(world.grants.of(talker.key)) == [grant]
    world.enactor.carry_out(world.graph.unregistered(new, Kind.SUBSCRIPTION, "/a"))
    assert list(world.grants.of(talker.key)) == []


async def test_who_lost_a_topic_is_told_again_by_the_next_control() -> None:
    """Control may have died before it told it: whoever still knows a publisher would never hear it again."""
    world = await ControlParts.begun()
    node = world.node("/ear")
    await world.register(node, Kind.SUBSCRIPTION, "/secret")
    await world.register(node, Kind.SUBSCRIPTION, "/plain")
    world.reload(POLICY.format("", "/secret=\n"))
    world.deliveries.told.clear()
    world.enactor.carry_out(world.graph.tell_everybody())
    emptied: tuple[str, str, tuple[Value, ...]] = ("/ear", "publisherUpdate", ("/secret", []))
    assert emptied in world.deliveries.told
    world.deliveries.told.clear()
    world.enactor.carry_out(world.graph.tell_everybody(lambda topic: topic == "/plain"))
    assert [params[0] for _name, _method, params in world.deliveries.told] == ["/plain"]


async def test_who_is_absent() -> None:
    """Whoever has a topic of somebody through the relay and is not connected, whether or not a grant is left."""
    world = await ControlParts.begun()
    talker, ear, other = world.node("/talker", 1), world.node("/ear", 2), world.node("/other", 3)
    await world.register(talker, Kind.PUBLICATION, "/a")
    for node in (talker, ear, other):
        await world.register(node, Kind.SUBSCRIPTION, "/a")
    connected = PermissionRow(talker.key, "topic", "/a", str(HOST), "/other")
    world.grants.used = lambda: {connected}
    assert list(world.graph.absent(world.registry.live())) == [(ear, "/a", [talker])]
    assert list(world.graph.absent([other])) == []


async def test_nobody_is_absent_where_nodes_connect_by_themselves() -> None:
    """What the relay does not carry has no connections there; the appliance's own nodes have all of theirs there."""
    world = await ControlParts.begun()
    cast(Any, world.mediation).carries_topic = lambda _topic: False
    talker, ear, own = world.node("/talker", 1), world.node("/ear", 2), world.node("/rosout", 3)
    own.own = True
    await world.register(talker, Kind.PUBLICATION, "/a")
    for node in (ear, own):
        await world.register(node, Kind.SUBSCRIPTION, "/a")
    assert list(world.graph.absent(world.registry.live())) == [(own, "/a", [talker])]
