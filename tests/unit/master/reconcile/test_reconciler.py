from typing import Any

import pytest

from appliance.master.graph.registry import Kind
from tests.support.control_parts import POLICY, ControlParts

pytestmark = pytest.mark.anyio
NO_SECRET = POLICY.format("/secret=\n", "/secret=\n")


@pytest.mark.parametrize("new_control", [True, False])
@pytest.mark.parametrize("new_master", [True, False])
async def test_each_subscriber_of_a_parameter_gets_its_value_after_a_start(
    new_control: bool, new_master: bool
) -> None:
    """If only the ROS master is new, the subscribers have the values already."""
    world = ControlParts()
    node = world.node("/n")
    for key in ("/speed", "/unset"):
        world.registry.register(node, Kind.PARAMETER, key, "")
    world.registry.take_changes()  # an earlier control made them
    world.hidden.parameters["speed"] = world.parameters.tree["speed"] = 2
    world.entries.pid = None if new_control else world.hidden.pid
    if new_master:
        world.hidden.restart()
    await world.round()
    expected = [("/n", "paramUpdate", ("/speed/", 2)), ("/n", "paramUpdate", ("/unset/", {}))]
    assert world.deliveries.told == (expected if new_control else [])
    assert world.hidden.parameters["speed"] == 2


async def test_a_new_master_is_complete_before_the_first_call() -> None:
    world = ControlParts(silent=3600.0)
    await world.round()
    node, other = world.node("/n", 1), world.node("/other", 2)
    await world.register(node, Kind.PUBLICATION, "/t")
    await world.register(other, Kind.PUBLICATION, "/u")
    world.rosmaster.shut()
    world.hidden.restart()
    world.graph.lost(node, "away")
    world.graph.returned(node)
    assert not world.rosmaster.reachable
    await world.round()
    assert (world.rosmaster.reachable, world.entries.pid) == (True, world.hidden.pid)
    assert [world.hidden.has(Kind.PUBLICATION, topic) for topic in ("/t", "/u")] == [["/n"], ["/other"]]


async def test_a_new_master_is_rebuilt_with_few_requests() -> None:
    world = ControlParts()
    await world.round()
    node = world.node("/n")
    names = [f"/t{number}" for number in range(400)]
    for name in reversed(names):
        world.graph.registered(node, Kind.PUBLICATION, name, "t")
    world.hidden.restart()
    world.hidden.requests.clear()
    await world.round()
    assert [call[2] for call in world.hidden.calls if call[0] == "registerPublisher"] == names[::-1]
    assert len(world.hidden.requests) < 12


async def test_a_lost_node_is_removed_with_few_requests() -> None:
    world = ControlParts()
    await world.round()
    gone = world.faces.inner_uri(world.node("/gone"))
    for number in range(400):
        await world.hidden.call("registerPublisher", "/gone", f"/t{number}", "t", gone)
    world.hidden.requests.clear()
    await world.round()
    assert not any(world.hidden.tables[Kind.PUBLICATION].values())
    assert len(world.hidden.requests) < 12


async def test_a_round_does_not_show_as_a_rebuild() -> None:
    world = ControlParts()
    seen: list[tuple[str, bool, bool]] = []
    call = world.hidden.call

    async def watched(method: str, *params: Any) -> Any:
        seen.append((method, world.rosmaster.reachable, world.rosmaster.whole))
        return await call(method, *params)

    world.hidden.call = watched  # type: ignore[method-assign]  # the same ROS master, observed
    assert not world.rosmaster.whole
    await world.round()
    await world.register(world.node("/n"), Kind.PUBLICATION, "/t")
    seen.clear()
    await world.round()
    assert {(reachable, whole) for _, reachable, whole in seen} == {(False, True)}
    world.hidden.restart()
    seen.clear()
    await world.round()
    assert {whole for method, _, whole in seen if method != "getPid"} == {False}
    assert (world.rosmaster.reachable, world.rosmaster.whole) == (True, True)
