"""Registering and giving up, while the policy changes."""

import asyncio

import pytest

from appliance.master.graph.registry import Kind
from tests.support.control_parts import HOST, OPEN, POLICY, ControlParts

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


async def test_the_next_call_is_decided_by_what_is_so_then() -> None:
    """The same words from the same address: a policy, a holder of the name, a node's new life, each counts at once."""
    world = await ControlParts.begun()

    async def registered(uri: str = URI, host: str = "10.0.0.5") -> bool:
        answer = await world.ask("registerPublisher", "/n", "/secret", "std_msgs/String", uri, host=host)
        assert isinstance(answer, list)
        return answer[0] == 1

    async def told(key: str) -> bool:
        answer = await world.ask("setParam", "/n", key, 1)
        assert isinstance(answer, list)
        return answer[0] == 1

    for policy, allowed in ((OPEN, True), (NO_SECRET, False), (OPEN, True), (NO_SECRET, False), (OPEN, True)):
        world.reload(policy)
        assert [await registered(), await registered()] == [allowed] * 2
    alike = "[Groups]\nsome = 10.0.0.0/24\n"
    assert world.current.alike(HOST) == "10.0.0.5/32"
    world.reload(alike + OPEN.replace("[Nodes]\n", "[Nodes]\n/some=some\n"))
    assert world.current.alike(HOST) == "10.0.0.0/24"
    world.reload(OPEN.replace("[Commands]\n", "[Commands]\nsetParam=10.0.0.9\n"))
    assert not await told("/a")
    world.reload(OPEN)
    assert await told("/a")
    new_life = URI.replace("4001", "4002")
    assert await registered(new_life)
    assert not await registered(URI)  # the life before is over
    assert await registered(new_life)


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
    assert world.grants.all() == []


async def test_what_a_tool_unregisters_by_what_it_was_told() -> None:
    """`rosnode cleanup` speaks for a node by the URIs that the lookups told it, on the node's own host."""
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


async def test_a_question_for_a_parameter_does_not_wait_for_the_master() -> None:
    """It is answered from the mirror, which has what ROSMaster took; a large namespace is asked of ROSMaster."""
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
