"""Registering and giving up, while the policy changes."""

import asyncio

import pytest

from appliance.master.registry import Kind
from tests.support.control_parts import OPEN, POLICY, ControlParts

pytestmark = pytest.mark.anyio
NO_SECRET = POLICY.format("/secret=\n", "/secret=\n")
URI = "http://10.0.0.5:4001/"
SERVICE_URI = "rosrpc://10.0.0.5:4101"


async def test_a_registration_that_waited_over_a_reload_is_decided_again() -> None:
    """Decided under the old policy and carried out under the new one: what that does not allow is taken back."""
    world = await ControlParts.begun()
    world.rosmaster.shut()
    call = asyncio.ensure_future(world.ask("registerPublisher", "/n", "/secret", "std_msgs/String", URI))
    while ("allow", "/secret") not in world.records.events:
        await asyncio.sleep(0)
    world.reload(NO_SECRET)
    await world.round()
    await call
    await world.settle()
    assert [one.resources(Kind.PUBLICATION) for one in world.registry.all()] == [[]]
    assert ("revoked", "/secret") in world.records.events
    assert world.hidden.has(Kind.PUBLICATION, "/secret") == []


async def test_a_service_that_is_looked_up_over_a_reload_is_not_granted() -> None:
    """The port is told, and nobody gets in by it."""
    world = await ControlParts.begun()
    await world.ask("registerService", "/n", "/s", SERVICE_URI, URI)
    world.rosmaster.shut()
    call = asyncio.ensure_future(world.ask("lookupService", "/client", "/s"))
    while world.records.events[-1] != ("allow", "/s"):
        await asyncio.sleep(0)
    world.reload(OPEN + "[Clients]\n")
    await world.round()
    await call
    assert world.relay.rows == []


@pytest.mark.parametrize(
    ("register", "unregister", "kind", "detail"),
    [
        ("registerPublisher", "unregisterPublisher", Kind.PUBLICATION, ["std_msgs/String", URI]),
        ("registerSubscriber", "unregisterSubscriber", Kind.SUBSCRIPTION, ["std_msgs/String", URI]),
        ("registerService", "unregisterService", Kind.SERVICE, [SERVICE_URI, URI]),
    ],
)
async def test_what_a_node_gives_up_is_not_given_back(
    register: str, unregister: str, kind: Kind, detail: list[str]
) -> None:
    """A node gives up what the policy has taken: it is denied, and a rollback does not bring a ghost back."""
    world = await ControlParts.begun()
    await world.ask(register, "/n", "/secret", *detail)
    await world.ask(register, "/n", "/plain", *detail)
    world.reload(NO_SECRET + "[Services]\n/secret=\ndefault=*\n")
    await world.settle()
    node = world.registry.all()[0]
    assert list(node.shelf) == [(kind, "/secret")]
    uri = detail[0] if kind is Kind.SERVICE else detail[-1]
    other_life = uri.replace("4001", "4009").replace("4101", "4109")
    await world.ask(unregister, "/n", "/secret", other_life)
    assert list(node.shelf) == [(kind, "/secret")]
    answer = await world.ask(unregister, "/n", "/secret", uri)
    assert isinstance(answer, list)
    assert answer[0] == 0
    assert not node.shelf
    world.reload(OPEN)
    await world.settle()
    assert (node.resources(kind), world.hidden.has(kind, "/secret")) == (["/plain"], [])


async def test_a_parameter_that_a_node_gives_up_is_not_given_back() -> None:
    """The same for a subscription to a parameter."""
    world = await ControlParts.begun()
    await world.ask("subscribeParam", "/n", URI, "/secret")
    world.reload(OPEN + "[Parameters]\nread default=*\nread /secret=\n")
    node = world.registry.all()[0]
    assert list(node.shelf) == [(Kind.PARAMETER, "/secret")]
    await world.ask("unsubscribeParam", "/n", URI, "/secret")
    assert not node.shelf
    await world.settle()
