import ipaddress
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.channel.messages import ConnectionOpened
from appliance.control.operators.overview import graph_of
from appliance.master.calls.call import Caller
from appliance.master.calls.node_calls import NodeCalls
from appliance.master.endpoints.traffic import RelayTraffic
from appliance.master.graph.registry import Incarnation, Kind, Registry
from appliance.telemetry.audit_trail import AuditTrail
from roswire.uris import parse_node_uri
from tests.support.idle import idle

pytestmark = pytest.mark.anyio
TOPICS, CONNECTIONS = 200, 300


class Counted(dict[Any, Any]):
    looks = 0

    def values(self) -> Any:
        for connection in super().values():
            self.looks += 1
            yield connection


async def test_each_connection_is_read_once() -> None:
    registry, uri, host = Registry(), "http://10.0.0.5:4000/", ipaddress.ip_address("10.0.0.5")
    node = Incarnation("key", "/node", host, parse_node_uri(uri), uri, "10.0.0.1", 1, 2)
    registry.add(node)
    for number in range(TOPICS):
        for kind in (Kind.PUBLICATION, Kind.SUBSCRIPTION, Kind.SERVICE):
            registry.register(node, kind, f"/{kind}_{number}", "std_msgs/String")
    carried = RelayTraffic(idle(AuditTrail), registry, 1, lambda _node, _topic: None)
    topic = f"/{Kind.PUBLICATION}_7"
    carried.connections = connections = Counted(
        {
            (0, number): ConnectionOpened(number, "key", topic, "topic", "10.0.0.6", "/ear")
            for number in range(CONNECTIONS)
        }
    )
    relay = SimpleNamespace(
        carried=carried, carries_topic=lambda _name: True, carries_service=lambda _name: True
    )
    other: Any = None
    parts = (registry, other, relay, other, other, other, other)
    calls = cast(Any, NodeCalls)(*parts, port=11311)
    answer: Any = await calls.get_bus_stats(cast(Caller, SimpleNamespace(target=node)))
    sent, received, _services = answer[2]
    assert (len(sent), len(received)) == (TOPICS, TOPICS)
    assert [name for name, _bytes, rows in sent if len(rows) == CONNECTIONS] == [topic]
    assert connections.looks == CONNECTIONS
    core, endpoints = SimpleNamespace(registry=registry), SimpleNamespace(relay=relay)
    graph = graph_of(cast(Any, SimpleNamespace(core=core, endpoints=endpoints)))
    assert {row.name: len(row.connections) for row in graph.topics if row.connections} == {topic: CONNECTIONS}
    assert len(graph.services) == TOPICS
    assert connections.looks <= 3 * CONNECTIONS
