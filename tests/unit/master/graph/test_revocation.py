"""After a change of the policy everything is decided again, whatever its node is doing at that moment."""

import pytest

from appliance.master.graph.registry import Kind, Life
from appliance.master.graph.revocation import revoked
from appliance.policy.policy_compiler import compile_policy
from appliance.store.state_file import PermissionRow
from roswire.xmlrpc import Value
from tests.support.control_parts import OPEN, POLICY, ControlParts

pytestmark = pytest.mark.anyio
NO_SECRET = POLICY.format("/secret=\n", "/secret=\n")


@pytest.mark.parametrize("kind", [Kind.PUBLICATION, Kind.SUBSCRIPTION])
async def test_a_node_that_is_away_keeps_nothing_the_policy_took(kind: Kind) -> None:
    """A node that stops answering over a reload comes back without what the new policy does not allow."""
    world = await ControlParts.begun()
    node = world.node("/n")
    await world.register(node, kind, "/secret")
    await world.register(node, kind, "/plain")
    world.clients.silent = {"/n"}
    await world.look(node)
    assert world.lives == [Life.SHADOW]
    assert world.reload(NO_SECRET) == 1
    world.clients.silent = set()
    await world.look(node)
    assert world.lives == [Life.LIVE]
    assert node.resources(kind) == ["/plain"]
    assert (world.hidden.has(kind, "/secret"), world.hidden.has(kind, "/plain")) == ([], ["/n"])
    emptied: tuple[str, str, tuple[Value, ...]] = ("/n", "publisherUpdate", ("/secret", []))
    assert (emptied in world.deliveries.told) == (kind is Kind.SUBSCRIPTION)


async def test_a_node_that_is_away_gets_back_what_is_granted_again() -> None:
    """Taken and granted again while the node was away: it has it when it returns."""
    world = await ControlParts.begun()
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
    world = await ControlParts.begun()
    node = world.node("/n")
    await world.register(node, Kind.PUBLICATION, "/plain")
    world.clients.silent = {"/n"}
    await world.look(node)
    assert revoked(world.revocation.expel(node.host, "the host was revoked")) == 1
    assert not node.registrations


async def test_given_and_taken_again_at_once_is_taken() -> None:
    """Of two quick reloads the last one counts, in the registry and at ROSMaster."""
    world = await ControlParts.begun()
    node = world.node("/n")
    await world.register(node, Kind.PUBLICATION, "/secret")
    world.reload(NO_SECRET)
    await world.settle()
    world.reload(OPEN)
    world.reload(NO_SECRET)
    await world.settle()
    assert (node.resources(Kind.PUBLICATION), world.hidden.has(Kind.PUBLICATION, "/secret")) == ([], [])
    world.reload(OPEN)
    world.reload(NO_SECRET)
    world.reload(OPEN)
    await world.settle()
    assert node.resources(Kind.PUBLICATION) == ["/secret"]
    assert world.hidden.has(Kind.PUBLICATION, "/secret") == ["/n"]


async def test_nothing_is_given_back_to_a_life_that_is_over() -> None:
    """A node that was started anew while its earlier life's registration is put back keeps its name."""
    world = await ControlParts.begun()
    first, second = world.node("/n", 1), world.node("/n", 2)
    await world.register(first, Kind.PUBLICATION, "/secret")
    await world.register(first, Kind.PUBLICATION, "/plain")
    world.reload(NO_SECRET)
    await world.settle()
    world.reload(OPEN)
    await world.register(second, Kind.PUBLICATION, "/plain")
    await world.settle()
    assert world.lives == [Life.REPLACED, Life.LIVE]
    assert world.registry.holder("/n") is second
    assert second.resources(Kind.PUBLICATION) == ["/plain"]
    assert world.hidden.has(Kind.PUBLICATION, "/secret") == []
    assert world.hidden.nodes["/n"] == world.faces.inner_uri(second)


async def test_a_service_that_another_offers_meanwhile_stays_his() -> None:
    """A provider whose offer is granted again does not take the service from the one that came after it."""
    world = await ControlParts.begun()
    first, second = world.node("/a", 1), world.node("/b", 2)
    await world.register(first, Kind.SERVICE, "/s", "4101")
    world.reload(OPEN + "[Services]\n")
    world.reload(OPEN + "[Services]\ndefault=*\n/none=\n")
    await world.settle()
    assert first.resources(Kind.SERVICE) == ["/s"]
    world.reload(OPEN + "[Services]\n")
    await world.settle()
    world.current = compile_policy(OPEN, file="policy")
    await world.register(second, Kind.SERVICE, "/s", "4102")
    world.reload(OPEN)
    await world.settle()
    assert (first.resources(Kind.SERVICE), second.resources(Kind.SERVICE)) == ([], ["/s"])
    assert world.hidden.has(Kind.SERVICE, "/s") == ["/b"]
    assert not first.shelf


async def test_only_what_one_caller_has_is_decided_again() -> None:
    """After a call that was decided under an earlier policy: his registrations and grants, nobody else's."""
    world = await ControlParts.begun()
    node, other = world.node("/n", 1), world.node("/m", 2)
    for one in (node, other):
        await world.register(one, Kind.PUBLICATION, "/secret")
    mine = PermissionRow(other.key, "topic", "/secret", str(node.host), "/n")
    called = PermissionRow(other.key, "service", "/secret", str(node.host), "/n")
    theirs = PermissionRow(node.key, "topic", "/secret", str(node.host), "/m")
    for row in (mine, called, theirs):
        world.grants.give(row)
    world.current = compile_policy(NO_SECRET + "[Clients]\n", file="policy")
    assert world.redecide_for(node.host, "/n") == 3
    assert (node.resources(Kind.PUBLICATION), other.resources(Kind.PUBLICATION)) == ([], ["/secret"])
    assert world.grants.all() == [theirs]
