import asyncio

import pytest

from appliance.master.endpoints.delivery import Delivery, NodeCall
from appliance.master.graph.registry import Incarnation, Kind, Life
from appliance.quotas.pool import QuotaClass
from tests.support.control_parts import ControlParts

pytestmark = pytest.mark.anyio


class Street(ControlParts):
    def surround(self) -> None:
        self.delivery = Delivery(
            self.nodes,
            troubled=self.watchlist.could_not_tell,
            quota_class=lambda _host: QuotaClass.REGISTERED,
            tries=1,
        )

    async def two_at_one_address(self) -> tuple[Incarnation, Incarnation]:
        await self.round()
        first, second = self.node("/first", 1), self.node("/second", 1)
        await self.register(first, Kind.SUBSCRIPTION, "/t")
        await self.look(first)
        await self.register(second, Kind.SUBSCRIPTION, "/u")
        return first, second


async def test_the_name_of_a_dead_node_is_registered_again() -> None:
    street = Street()
    dead, heir = await street.two_at_one_address()
    await street.register(street.node("/first", 2), Kind.SUBSCRIPTION, "/t")
    await street.settle()
    assert dead.life is Life.REPLACED
    assert "shutdown" not in {method for _port, method in street.nodes.heard}
    assert heir.life is Life.LIVE


async def test_the_earlier_incarnation_is_shut_down() -> None:
    street = Street()
    await street.round()
    await street.register(street.node("/first", 1), Kind.SUBSCRIPTION, "/t")
    await street.register(street.node("/first", 2), Kind.SUBSCRIPTION, "/t")
    await street.settle()
    assert (4001, "shutdown") in street.nodes.heard


async def test_the_answer_of_another_process_does_not_revive_a_node() -> None:
    street = Street()
    dead, heir = await street.two_at_one_address()
    street.nodes.process = 2
    for node in (dead, heir, dead):
        await street.look(node)
    assert (dead.life, heir.life) == (Life.SHADOW, Life.LIVE)
    street.liveness.revive(dead)
    await street.look(dead)
    await street.look(dead)
    assert dead.life is Life.LIVE


async def test_a_node_that_restarts_at_its_address() -> None:
    street = Street()
    node, _other = await street.two_at_one_address()
    street.nodes.process = 2
    node.touched += 1  # as each registering call does
    await street.look(node)
    await street.look(node)
    assert node.life is Life.LIVE


@pytest.mark.parametrize(
    "telling", [NodeCall("publisherUpdate", ("/t", [])), NodeCall("shutdown", ("by hand",))]
)
async def test_programs_that_serve_two_nodes_with_one_api(telling: NodeCall) -> None:
    street = Street()
    nodes = await street.two_at_one_address()
    for node in nodes:
        await street.look(node)
        await street.look(node)
    assert [node.life for node in nodes] == [Life.LIVE, Life.LIVE]
    street.nodes.heard.clear()
    for node in nodes:
        street.delivery.push(node, telling)
        await street.settle()
    assert street.nodes.heard == [(4001, telling.method)] * 2


async def test_a_connection_is_kept_for_the_next_call_but_not_to_find_out_whether_a_node_is_there() -> None:
    """On its old connection, a process that is gone would seem silent."""
    street = Street()
    nodes = street.nodes
    first, second = street.node("/first", 1), street.node("/second", 2)
    for method in ("requestTopic", "publisherUpdate", "getPid", "paramUpdate", "shutdown"):
        await nodes.call(first, method)
    await nodes.call(second, "requestTopic")
    assert [(used.node, used.pool) for used in nodes.used] == [
        ("/first", 1),
        ("/first", 0),
        ("/first", 0),
        ("/second", 1),
    ]
    await asyncio.sleep(1.5)
    await nodes.call(second, "requestTopic")
    assert (len(nodes.used), nodes.closed) == (4, [])
    await asyncio.sleep(1)
    assert nodes.closed == ["/first"]
    await asyncio.sleep(2)
    assert nodes.closed == ["/first", "/second"]
