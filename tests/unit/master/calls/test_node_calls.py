import ipaddress
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.channel.messages import ConnectionOpened
from appliance.control.operators.queries import graph_of
from appliance.master.calls.call import Attempt, Caller, NotServedError, ServedCall
from appliance.master.calls.call_execution import ServedRequest
from appliance.master.calls.node_calls import NODE_CALLS
from appliance.master.graph.registry import Kind
from appliance.rpc.server import Peer
from appliance.store.writer_thread import StoreError
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


@pytest.mark.parametrize("error", [NotServedError("not here"), StoreError("the disk is full")])
async def test_each_call_that_is_not_carried_out_is_answered_and_recorded_as_denied(error: Exception) -> None:
    world = await ControlParts.begun()

    async def fails(*_given: object) -> Any:
        raise error

    part = SimpleNamespace(method=SimpleNamespace(perform=fails))
    peer = Peer(ipaddress.ip_address("10.0.0.5"), "10.0.0.5", "10.0.0.1")
    for call in [*NODE_CALLS.values(), *(row.call for row in world.table.values())]:
        visit = ServedRequest(
            {call.name: ServedCall(cast(Any, part), None)}, Caller(peer, "/n", 0), cast(Any, None)
        )
        attempt = Attempt(visit.caller, call, ("/x",) * len(call.method.parameters))
        world.records.clear()
        answer: Any = await world.pipeline.execution._perform(visit, attempt)
        assert (answer[0], answer[2]) == (0, call.denial), call.name
        assert str(error) in answer[1]
        assert world.records.pairs == [("deny", attempt.request.resource)]


@pytest.mark.parametrize("protocols", [[["UDPROS", "x", 4]], [[]], [["UDPROS"], ["SHM"]]])
async def test_a_subscriber_that_does_not_offer_tcpros_is_recorded_as_denied(protocols: list[Any]) -> None:
    world = await ControlParts.begun()
    voice = world.node("/voice")
    await world.register(voice, Kind.PUBLICATION, "/chatter", "std_msgs/String")
    world.records.clear()
    answer: Any = await world.ask("requestTopic", "/ear", "/chatter", protocols, target=voice)
    assert answer[0] == 0
    assert world.records.pairs[-1] == ("deny", "/chatter")


async def test_an_order_about_monitors_on_a_full_disk_is_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    world = await ControlParts.begun()

    async def full(*_given: object) -> Any:
        raise StoreError("1000 bytes are free; nothing was changed: free space and try again")

    monkeypatch.setattr(world.specifications, "switch", full, raising=False)
    world.records.clear()
    answer: Any = await world.ask("monitorControl", "/tool", "disable", ["a"])
    assert (answer[0], answer[2]) == (0, [])
    assert "free space and try again" in answer[1]
    assert world.records.pairs[-1] == ("deny", "monitorControl")
