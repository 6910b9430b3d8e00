from typing import Any

import pytest

from appliance.channel.messages import ConnectionOpened
from appliance.control.operators.queries import graph_of
from appliance.master.graph.registry import Kind
from tests.support.control_parts import ControlParts

pytestmark = pytest.mark.anyio
TOPICS, CONNECTIONS = 200, 300


class Counted(dict[tuple[int, int], ConnectionOpened]):
    looks = 0

    def values(self) -> Any:
        for connection in super().values():
            self.looks += 1
            yield connection


async def test_each_connection_is_read_once() -> None:
    world = await ControlParts.begun()
    node = world.node("/node")
    for number in range(TOPICS):
        for kind in (Kind.PUBLICATION, Kind.SUBSCRIPTION, Kind.SERVICE):
            world.registry.register(node, kind, f"/{kind}_{number}", "4001")
    topic = f"/{Kind.PUBLICATION}_7"
    opened = [
        ConnectionOpened(number, node.key, topic, "topic", "10.0.0.6", "/ear")
        for number in range(CONNECTIONS)
    ]
    world.carried.connections = connections = Counted({(0, one.number): one for one in opened})
    answer: Any = await world.ask("getBusStats", "/tool", target=node)
    sent, received, _services = answer[2]
    assert (len(sent), len(received)) == (TOPICS, TOPICS)
    assert [name for name, _bytes, rows in sent if len(rows) == CONNECTIONS] == [topic]
    assert connections.looks == CONNECTIONS
    graph = graph_of(world.registry, world.relay)
    assert {row.name: len(row.connections) for row in graph.topics if row.connections} == {topic: CONNECTIONS}
    assert len(graph.services) == TOPICS
    assert connections.looks <= 3 * CONNECTIONS


async def test_a_node_that_ended_is_not_shown_and_a_lost_or_withdrawn_one_is() -> None:
    world = await ControlParts.begun()
    nodes = {name: world.node(f"/{name}") for name in ("there", "ended", "withdrawn", "lost")}
    for node in nodes.values():
        world.registry.register(node, Kind.PUBLICATION, f"/topic{node.name}", "std_msgs/String")
    topic = Kind.PUBLICATION, "/topic/ended"
    world.registry.unregister(nodes["ended"], *topic)
    [withdrawn] = nodes["withdrawn"].registrations.values()
    world.registry.shelve(nodes["withdrawn"], withdrawn)
    world.registry.unregister(nodes["withdrawn"], withdrawn.kind, withdrawn.resource)
    world.registry.overshadow(nodes["lost"], 1.0)
    graph = graph_of(world.registry, world.relay)
    assert {one.name: one.state for one in graph.nodes} == {
        "/there": "live", "/withdrawn": "live", "/lost": "lost",
    }  # fmt: skip
    world.registry.register(nodes["ended"], *topic, "std_msgs/String")
    assert "/ended" in {one.name for one in graph_of(world.registry, world.relay).nodes}
