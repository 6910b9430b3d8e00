"""After a change of the policy everything is decided again, whatever its node is doing at that moment."""

import pytest

from appliance.master.registry import Kind, Life
from appliance.ros.xmlrpc import Value
from tests.support.control_parts import OPEN, POLICY, ControlParts

pytestmark = pytest.mark.anyio
NO_SECRET = POLICY.format("/secret=\n", "/secret=\n")


@pytest.fixture
def anyio_backend() -> str:
    """The loop that control runs on."""
    return "asyncio"


async def parts() -> ControlParts:
    """Control after its first round."""
    world = ControlParts()
    await world.round()
    return world


def lives(world: ControlParts) -> list[Life]:
    """Where each incarnation stands."""
    return [one.life for one in world.registry.all()]


@pytest.mark.parametrize("kind", [Kind.PUBLICATION, Kind.SUBSCRIPTION])
async def test_a_node_that_is_away_keeps_nothing_the_policy_took(kind: Kind) -> None:
    """A node that stops answering over a reload comes back without what the new policy does not allow."""
    world = await parts()
    node = world.node("/n")
    await world.register(node, kind, "/secret")
    await world.register(node, kind, "/plain")
    world.clients.silent = {"/n"}
    await world.look(node)
    assert lives(world) == [Life.SHADOW]
    assert world.reload(NO_SECRET) == 1
    world.clients.silent = set()
    await world.look(node)
    assert lives(world) == [Life.LIVE]
    assert node.resources(kind) == ["/plain"]
    assert (world.hidden.has(kind, "/secret"), world.hidden.has(kind, "/plain")) == ([], ["/n"])
    emptied: tuple[str, str, tuple[Value, ...]] = ("/n", "publisherUpdate", ("/secret", []))
    assert (emptied in world.deliveries.told) == (kind is Kind.SUBSCRIPTION)


async def test_a_node_that_is_away_gets_back_what_is_granted_again() -> None:
    """Taken and granted again while the node was away: it has it when it returns."""
    world = await parts()
    node = world.node("/n")
    await world.register(node, Kind.PUBLICATION, "/secret")
    await world.register(node, Kind.PUBLICATION, "/plain")
    world.clients.silent = {"/n"}
    await world.look(node)
    world.reload(NO_SECRET)
    world.reload(OPEN)
    world.clients.silent = set()
    await world.look(node)
    assert sorted(node.resources(Kind.PUBLICATION)) == ["/plain", "/secret"]
    assert world.hidden.has(Kind.PUBLICATION, "/secret") == ["/n"]
    assert not node.shelf


async def test_a_revoked_host_keeps_nothing_of_nodes_that_are_away() -> None:
    """Expelling a host takes what its silent nodes have, too."""
    world = await parts()
    node = world.node("/n")
    await world.register(node, Kind.PUBLICATION, "/plain")
    world.clients.silent = {"/n"}
    await world.look(node)
    assert world.revocation.expel(node.host, "the host was revoked") == 1
    assert not node.registrations
