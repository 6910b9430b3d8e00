"""Nodes that go away and come back: what they had, what others got meanwhile, what the policy took."""

import pytest

from appliance.master.registry import Kind, Life
from tests.support.control_parts import ControlParts

pytestmark = pytest.mark.anyio


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


async def test_a_service_has_one_provider_when_the_first_returns() -> None:
    """Another offered the service while its provider was away: it stays his, and no round swaps the two."""
    world = await parts()
    first, second = world.node("/a", 1), world.node("/b", 2)
    await world.register(first, Kind.SERVICE, "/s", "4101")
    await world.register(first, Kind.PUBLICATION, "/plain")
    world.clients.silent = {"/a"}
    await world.look(first)
    await world.register(second, Kind.SERVICE, "/s", "4102")
    world.clients.silent = set()
    await world.look(first)
    assert lives(world) == [Life.LIVE, Life.LIVE]
    assert [one.name for one in world.registry.registered(Kind.SERVICE, "/s")] == ["/b"]
    assert first.resources(Kind.PUBLICATION) == ["/plain"]
    for _ in range(3):
        await world.round()
        assert world.hidden.has(Kind.SERVICE, "/s") == ["/b"]


async def test_a_service_that_nobody_took_comes_back() -> None:
    """Without another provider a returned node has its service again."""
    world = await parts()
    node = world.node("/a")
    await world.register(node, Kind.SERVICE, "/s", "4101")
    world.clients.silent = {"/a"}
    await world.look(node)
    assert world.hidden.has(Kind.SERVICE, "/s") == []
    world.clients.silent = set()
    await world.look(node)
    assert world.hidden.has(Kind.SERVICE, "/s") == ["/a"]
