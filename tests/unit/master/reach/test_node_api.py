"""A node was killed and another has its port: nothing that is meant for the one reaches the other."""

from typing import Any, cast

import pytest

from appliance.master.graph.effects import NodeCall
from appliance.master.graph.registry import Incarnation, Kind, Life
from appliance.master.reach.delivery import Delivery
from appliance.ros.xmlrpc import Value
from appliance.rpc.client import RefusedError
from appliance.shares.pool import Standing
from tests.support.control_parts import ControlParts

pytestmark = pytest.mark.anyio
TELLINGS = [
    NodeCall("publisherUpdate", ("/t", [])),
    NodeCall("paramUpdate", ("/p/", 1)),
    NodeCall("shutdown", ("replaced",)),
]


class Street(ControlParts):
    """Control, with the queues of calls to nodes; who is called at which port: everybody answers."""

    def surround(self) -> None:
        """As `ControlParts`."""
        self.heard: list[tuple[int, str]] = []
        cast(Any, self.nodes).client = lambda node: _Door(self, node)
        self.delivery = Delivery(
            self.nodes,
            troubled=self.watchlist.could_not_tell,
            standing=lambda _host: Standing.REGISTERED,
            tries=1,
        )
        self.deliveries = cast(Any, self.delivery)

    async def moved_in(self) -> tuple[Incarnation, Incarnation]:
        """/dead was killed, and /heir has its port since; both have registered."""
        await self.round()
        dead, heir = self.node("/dead", 1), self.node("/heir", 1)
        await self.register(dead, Kind.SUBSCRIPTION, "/t")
        await self.register(heir, Kind.SUBSCRIPTION, "/u")
        return dead, heir


class _Door:
    def __init__(self, street: Street, node: Incarnation) -> None:
        self._street, self._port = street, node.api.port

    async def call(self, method: str, *_params: Value) -> Value:
        self._street.heard.append((self._port, method))
        return [1, "", 1]


@pytest.mark.parametrize("telling", TELLINGS, ids=[one.method for one in TELLINGS])
async def test_who_has_the_port_now_is_told_nothing_of_the_dead(telling: NodeCall) -> None:
    """Neither a list, nor a parameter, nor to shut down; what is meant for it arrives."""
    street = Street()
    dead, heir = await street.moved_in()
    street.delivery.push(dead, telling)
    await street.settle()
    assert street.heard == []
    street.delivery.push(heir, telling)
    await street.settle()
    assert street.heard == [(4001, telling.method)]


async def test_the_name_of_the_dead_is_registered_anew() -> None:
    """The order to shut down for the earlier life is not carried out on the node that has its port."""
    street = Street()
    dead, heir = await street.moved_in()
    await street.register(street.node("/dead", 2), Kind.SUBSCRIPTION, "/t")
    await street.settle()
    assert dead.life is Life.REPLACED
    assert "shutdown" not in {method for _port, method in street.heard}
    assert heir.life is Life.LIVE


async def test_an_answer_from_that_address_is_no_life_of_the_dead() -> None:
    """The dead is lost at the next look, does not return by the other's answer, and returns when it registers."""
    street = Street()
    dead, heir = await street.moved_in()
    await street.look(dead)
    await street.look(dead)
    assert (dead.life, heir.life, street.heard) == (Life.SHADOW, Life.LIVE, [])
    await street.register(dead, Kind.SUBSCRIPTION, "/t")
    await street.look(heir)
    assert (dead.life, heir.life) == (Life.LIVE, Life.SHADOW)


async def test_the_address_is_free_again_when_its_holder_is_gone() -> None:
    """A node that shares its address with one that is forgotten is called again."""
    street = Street()
    dead, heir = await street.moved_in()
    with pytest.raises(RefusedError, match="/heir has that address now"):
        await street.nodes.call(dead, "getPid", "/rosrv")
    street.enactor.carry_out(street.graph.forgotten(heir))
    assert await street.nodes.call(dead, "getPid", "/rosrv") == [1, "", 1]
