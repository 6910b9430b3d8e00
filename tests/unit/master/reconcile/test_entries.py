import asyncio
from typing import Any

import pytest

from appliance.master.graph.registry import Kind
from appliance.rpc.xmlrpc_client import BrokenOffError, CallFailedError, UnansweredError
from tests.support.control_parts import ControlParts

pytestmark = pytest.mark.anyio
TYPE = "std_msgs/String"


def uri(number: int = 1) -> str:
    return f"http://10.0.0.5:{4000 + number}/"


async def started() -> ControlParts:
    world = await ControlParts.begun()
    world.hidden.calls.clear()
    world.hidden.requests.clear()
    return world


def changes(world: ControlParts) -> list[tuple[Any, Any]]:
    return [(call[0], call[2]) for call in world.hidden.calls if "egister" in str(call[0])]


async def test_many_changes_go_in_order_in_few_requests() -> None:
    world = await started()
    node = world.node("/n")
    for number in range(200):
        world.graph.registered(node, Kind.PUBLICATION, f"/t{number}", TYPE)
        world.sinks.flush()
        if number % 2:
            world.graph.unregistered(node, Kind.PUBLICATION, f"/t{number}")
    await world.settle()
    assert changes(world) == [("registerPublisher", f"/t{number}") for number in range(0, 200, 2)]
    assert (world.hidden.requests, world.hidden.most_under_way) == (["system.multicall"] * 2, 1)


async def test_a_change_while_its_registration_is_under_way_follows() -> None:
    world = await started()
    node = world.node("/n")
    world.hidden.go.clear()
    world.graph.registered(node, Kind.PUBLICATION, "/t", TYPE)
    while not world.hidden.requests:
        await asyncio.sleep(0.01)
    world.graph.unregistered(node, Kind.PUBLICATION, "/t")
    await asyncio.sleep(1.0)
    world.hidden.go.set()
    await world.settle()
    assert changes(world) == [("registerPublisher", "/t"), ("unregisterPublisher", "/t")]
    assert not world.hidden.has(Kind.PUBLICATION, "/t")


async def test_a_new_type_of_a_topic_reaches_the_ros_master() -> None:
    world = await started()
    node = world.node("/n")
    for type_name in ("*", TYPE, TYPE):
        await world.register(node, Kind.PUBLICATION, "/t", type_name)
    assert [call[3] for call in world.hidden.calls if call[0] == "registerPublisher"] == ["*", TYPE]


@pytest.mark.parametrize(
    "failure", [BrokenOffError("gone"), UnansweredError("late"), CallFailedError("fault")]
)
async def test_a_failed_change_is_not_repeated(failure: Exception) -> None:
    world = await started()
    world.hidden.failure = failure
    await world.ask("registerPublisher", "/n", "/t", TYPE, uri())
    await asyncio.wait_for(world.rosmaster.doubtful.wait(), 10)
    assert not world.rosmaster.reachable
    world.hidden.restart()
    await world.ask("registerPublisher", "/n", "/later", TYPE, uri())
    world.hidden.calls.clear()
    world.hidden.failure = None
    await world.round()
    await world.settle()
    assert changes(world) == [("registerPublisher", "/t"), ("registerPublisher", "/later")]


async def test_a_rejected_change_causes_a_round() -> None:
    world = await started()
    world.hidden.answer = [
        [[1, "", []]],
        {"faultCode": 1, "faultString": "no such thing"},
        [[-1, "invalid", 0]],
    ]
    world.rosmaster.doubtful.clear()
    for number in range(3):
        await world.ask("registerPublisher", "/n", f"/t{number}", TYPE, uri())
    await world.settle()
    assert (world.rosmaster.doubtful.is_set(), world.rosmaster.reachable) == (True, True)


async def test_a_host_fills_no_queue_while_the_ros_master_is_away() -> None:
    """The changes that wait have the bounds of the registry, so calls need not wait for the ROS master."""
    world = await started()
    world.rosmaster.shut()
    for number in range(2000):
        for call, *about in (("registerPublisher", TYPE), ("unregisterPublisher",)):
            answer: Any = await world.ask(call, "/flood", f"/t{number}", *about, uri())
            assert answer[0] == 1
    assert world.entries.differing == 0
    await world.round()
    await world.settle()
    assert changes(world) == []


async def test_a_round_replaces_the_waiting_changes() -> None:
    world = await started()
    old, new = world.node("/n", 1), world.node("/n", 2)
    world.rosmaster.shut()
    for node, topic in ((new, "/kept"), (old, "/old"), (new, "/new")):
        if node is old:
            world.graph.lost(new, "away")
        world.graph.registered(node, Kind.PUBLICATION, topic, TYPE)
    world.hidden.calls.clear()
    await world.round()
    await world.settle()
    assert changes(world) == [("registerPublisher", "/kept"), ("registerPublisher", "/new")]
