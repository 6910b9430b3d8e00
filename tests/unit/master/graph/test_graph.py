"""What the graph tells and takes when lives of one name overlap, and when control has died over a change."""

import pytest

from appliance.master.graph.registry import Kind, Life
from appliance.ros.xmlrpc import Value
from appliance.store.state import PermissionRow
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
