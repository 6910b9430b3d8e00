"""After a change of the policy every right is decided again, whatever the nodes do during the change."""

import pytest

from appliance.master.graph.registry import Kind, Life
from appliance.policy.policy_compiler import compile_policy
from appliance.store.state_file import PermissionRow
from tests.support.control_parts import OPEN, POLICY, ControlParts

pytestmark = pytest.mark.anyio
NO_SECRET = POLICY.format("/secret=\n", "/secret=\n")


async def test_an_earlier_incarnation_gets_nothing_back() -> None:
    """The name stays with a restarted node while the registration of its earlier incarnation is restored."""
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


async def test_only_the_rights_of_one_caller_are_decided_again() -> None:
    """After a call under an earlier policy, only that caller's registrations and grants are decided again."""
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
