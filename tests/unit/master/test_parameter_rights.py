"""Subscriptions to parameters follow what is there: a right to a value is none to a namespace in its place."""

from typing import Any

import pytest

from appliance.master.graph.registry import Kind
from roswire.xmlrpc import Value
from tests.support.control_parts import HOST, OPEN, ControlParts
from tests.support.parameters import put

pytestmark = pytest.mark.anyio
EXACT = OPEN + "[Parameters]\nread /arm = 10.0.0.5\nread /arm/free = 10.0.0.5\nread default = 10.0.0.9\n"
WHOLE = OPEN + "[Parameters]\nread /arm/** = 10.0.0.5\nread default = 10.0.0.9\n"


async def subscribed(policy: str, value: Value = 7) -> tuple[ControlParts, Any]:
    """Control with a node that subscribed to the parameter /arm, under this policy."""
    world = ControlParts()
    await world.round()
    world.reload(policy)
    put(world.parameters, "/arm", value, HOST)
    world.hidden.parameters["arm"] = value
    node = world.node("/n")
    await world.register(node, Kind.PARAMETER, "/arm", "")
    return world, node


def told(world: ControlParts) -> list[tuple[Value, ...]]:
    """The parameters that the node was told."""
    return [parameters for _, method, parameters in world.deliveries.told if method == "paramUpdate"]


@pytest.mark.parametrize(
    ("key", "value"), [("/arm/speed", 4711), ("/arm", {"speed": 4711}), ("/", {"arm": 4711})]
)
async def test_what_came_to_be_below_a_key_is_told_to_who_may_read_it(key: str, value: Value) -> None:
    """A subscription to a value is none to what others put in its place: that is held back, and recorded."""
    world, node = await subscribed(EXACT)
    world.enactor.carry_out(world.graph.tell_parameter(node, key, value))
    assert not told(world)
    assert ("deny", key) in world.records.events


async def test_what_may_be_read_is_told() -> None:
    """Values that the policy grants, and that they are gone; everything where there is no section."""
    world, node = await subscribed(EXACT)
    updates: list[tuple[str, Value]] = [("/arm", 7), ("/arm", {}), ("/arm/free", 1)]
    for key, value in updates:
        world.enactor.carry_out(world.graph.tell_parameter(node, key, value))
    assert told(world) == [(f"{key}/", value) for key, value in updates]
    for policy in (OPEN, WHOLE):
        world, node = await subscribed(policy)
        world.enactor.carry_out(world.graph.tell_parameter(node, "/arm/speed", 4711))
        assert told(world) == [("/arm/speed/", 4711)]


async def test_a_reload_decides_a_subscription_by_what_is_there() -> None:
    """With the right to the value left, a subscription to the value stays, and one to a namespace is taken back."""
    cases: list[tuple[Value, int]] = [(7, 0), ({"speed": 4711}, 1)]
    for value, taken in cases:
        world, node = await subscribed(WHOLE, value)
        assert world.reload(EXACT) == taken
        assert node.resources(Kind.PARAMETER) == ([] if taken else ["/arm"])
        await world.settle()


async def test_a_node_that_returns_is_told_what_it_may_read() -> None:
    """A namespace that came while the node was away is not told to it with the subscription that is put back."""
    for policy, expected in ((EXACT, []), (WHOLE, [("/arm/", {"speed": 4711})])):
        world, node = await subscribed(policy)
        world.clients.silent = {"/n"}
        await world.look(node)
        world.hidden.parameters["arm"] = {"speed": 4711}
        world.clients.silent = set()
        await world.look(node)
        assert told(world) == expected
