import pytest

from appliance.channel.messages import MonitorCallAnswered, MonitorCallWanted
from appliance.control.monitor_call_gate import MonitorCallGate, own_host
from appliance.master.graph.registry import Kind
from appliance.policy.policy_compiler import compile_policy
from appliance.store.state_file import PermissionRow
from tests.support.control_parts import ControlParts

pytestmark = pytest.mark.anyio
ALLOWED = "[Commands]\nlookupService = 127.0.0.1\n[Clients]\n/arm = 127.0.0.1\n"


def world_with(*services: str) -> ControlParts:
    world = ControlParts()
    node = world.node("/node")
    for service in services:
        world.registry.register(node, Kind.SERVICE, service, "4001")
    return world


async def asked(world: ControlParts, policy: str = ALLOWED, host: str = "127.0.0.1") -> MonitorCallAnswered:
    compiled = compile_policy(policy, file="p.ini")
    gate = MonitorCallGate(
        world.registry,
        world.graph,
        world.sinks.flush,
        lambda: compiled,
        world.records,
        world.relay,
        "/rosrv",
        host,
    )
    return await gate.answer(MonitorCallWanted(7, "/arm"))


async def test_an_allowed_call_is_recorded_and_granted() -> None:
    """The grant is like a client's, so its revocation by another policy cuts the call."""
    world = world_with("/arm")
    [node] = world.registry.all()
    assert await asked(world) == MonitorCallAnswered(7, "127.0.0.1", node.relay_port, "/rosrv", "")
    [record] = world.records.records
    assert (record.host, record.caller_id, record.detail["call"]) == (
        "127.0.0.1",
        "/rosrv",
        "lookupService",
    )
    assert (record.resource, record.decision) == ("/arm", "allow")
    assert world.grants.all() == [PermissionRow(node.key, "service", "/arm", "127.0.0.1", "/rosrv")]


@pytest.mark.parametrize(
    ("listen", "host"),
    [("0.0.0.0", "127.0.0.1"), ("::", "127.0.0.1"), ("10.0.0.9", "10.0.0.9"), ("::1", "::1")],
)
async def test_the_client_is_the_address_that_a_relay_connects_from(listen: str, host: str) -> None:
    """A relay that listens on one address cannot be reached on the loopback."""
    assert own_host(listen) == host
    world = world_with("/arm")
    answer = await asked(world, ALLOWED.replace("127.0.0.1", host), host)
    assert (answer.refused, answer.host) == ("", host)
    assert [record.host for record in world.records.records] == [host]
    assert [row.host for row in world.grants.all()] == [host]


@pytest.mark.parametrize(
    "policy",
    [
        "[Commands]\nlookupService = 127.0.0.1\n[Clients]\n/arm = 10.0.0.9\n",
        "[Commands]\nlookupService = 10.0.0.9\n",
    ],
)
async def test_a_denied_call_is_not_granted(policy: str) -> None:
    world = world_with("/arm")
    answer = await asked(world, policy)
    [record] = world.records.records
    assert answer.refused.startswith("denied: ") and answer.refused.endswith(f" [{record.id}]")
    assert (record.decision, world.grants.all()) == ("deny", [])


async def test_a_call_of_no_service_is_not_granted() -> None:
    world = world_with()
    assert (await asked(world)).refused == "no node offers the service"
    assert (len(world.records.records), world.grants.all()) == (1, [])


async def test_a_call_that_the_relay_does_not_carry_is_not_granted() -> None:
    world = world_with("/arm")
    world.relay.relay_all = False
    assert (await asked(world)).refused == "the relay does not carry the service"
    assert (len(world.records.records), world.grants.all()) == (1, [])


async def test_a_call_that_cannot_be_recorded_is_not_granted() -> None:
    world = world_with("/arm")
    world.records.strict, world.records.log.failure = True, "the disk is full"
    assert (await asked(world)).refused.startswith("denied: ")
    assert (len(world.records.records), world.grants.all()) == (1, [])
