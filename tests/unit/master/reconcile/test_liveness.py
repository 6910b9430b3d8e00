"""Nodes that go away and come back: what they had, what others got meanwhile, what the policy took."""

import asyncio
import ipaddress
import time
from typing import Any, cast

import pytest

from appliance.master.graph.effects import NodeCall
from appliance.master.graph.registry import Kind, Life
from appliance.master.reconcile import liveness
from appliance.rpc.xmlrpc_client import RefusedError
from roswire.xmlrpc import Value
from tests.support.control_parts import OPEN, POLICY, ControlParts

pytestmark = pytest.mark.anyio


async def test_a_service_has_one_provider_when_the_first_returns() -> None:
    """Another offered the service while its provider was away: it stays his, and no round swaps the two."""
    world = await ControlParts.begun()
    first, second = world.node("/a", 1), world.node("/b", 2)
    await world.register(first, Kind.SERVICE, "/s", "4101")
    await world.register(first, Kind.PUBLICATION, "/plain")
    world.clients.silent = {"/a"}
    await world.look(first)
    await world.register(second, Kind.SERVICE, "/s", "4102")
    world.clients.silent = set()
    await world.look(first)
    assert world.lives == [Life.LIVE, Life.LIVE]
    assert [one.name for one in world.registry.registered(Kind.SERVICE, "/s")] == ["/b"]
    assert first.resources(Kind.PUBLICATION) == ["/plain"]
    for _ in range(3):
        await world.round()
        assert world.hidden.has(Kind.SERVICE, "/s") == ["/b"]


async def test_a_service_that_nobody_took_comes_back() -> None:
    """Without another provider a returned node has its service again."""
    world = await ControlParts.begun()
    node = world.node("/a")
    await world.register(node, Kind.SERVICE, "/s", "4101")
    world.clients.silent = {"/a"}
    await world.look(node)
    assert world.hidden.has(Kind.SERVICE, "/s") == []
    world.clients.silent = set()
    await world.look(node)
    assert world.hidden.has(Kind.SERVICE, "/s") == ["/a"]


async def test_a_clock_that_is_set_forward_forgets_no_node(monkeypatch: pytest.MonkeyPatch) -> None:
    """A node that was lost a moment ago comes back with all it had, whatever year it is by then."""
    world = await ControlParts.begun()
    node = world.node("/n")
    await world.register(node, Kind.PUBLICATION, "/a")
    world.clients.silent = {"/n"}
    await world.look(node)
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() + 365 * 86_400)
    await world.look(node)
    world.clients.silent = set()
    await world.look(node)
    assert (node.life, world.hidden.has(Kind.PUBLICATION, "/a")) == (Life.LIVE, ["/n"])


async def test_a_node_that_missed_a_list_is_told_again_when_it_answers() -> None:
    """A list that a short outage swallowed comes again, once, though nobody took the node for lost.

    It may know that list, and have lost the connection meanwhile: so it is told first to drop the publisher.
    """
    world = ControlParts(silent=3600.0)
    await world.round()
    ear, mouth = world.node("/ear", 1), world.node("/mouth", 2)
    await world.register(ear, Kind.SUBSCRIPTION, "/t")
    await world.register(ear, Kind.SUBSCRIPTION, "/other")
    await world.register(mouth, Kind.PUBLICATION, "/t")
    world.deliveries.told.clear()
    world.clients.silent = {"/ear"}
    world.watchlist.could_not_tell(ear, NodeCall("publisherUpdate", ("/t", [])), "away")
    await world.settle()
    assert (world.lives, world.deliveries.told) == ([Life.LIVE, Life.LIVE], [])
    world.clients.silent = set()
    await world.look(ear)
    await world.look(ear)
    lists: list[tuple[str, list[str]]] = [("/t", []), ("/t", [mouth.outer_uri("10.0.0.1")])]
    assert world.deliveries.told == [("/ear", "publisherUpdate", each) for each in lists]


async def test_a_node_that_answers_and_takes_no_list_is_not_told_without_end() -> None:
    """It is told again once per look at it, not each time it fails."""
    world = await ControlParts.begun()
    ear = world.node("/ear", 1)
    await world.register(ear, Kind.SUBSCRIPTION, "/t")
    for _ in range(5):
        world.watchlist.could_not_tell(ear, NodeCall("publisherUpdate", ("/t", [])), "away")
        await world.settle()
    assert world.deliveries.told == [("/ear", "publisherUpdate", ("/t", []))]


async def test_what_was_missed_of_a_revoked_topic_is_that_it_is_empty() -> None:
    """The list of a topic that the policy took has nobody in it, also when it is told again."""
    world = await ControlParts.begun()
    ear, mouth = world.node("/ear", 1), world.node("/mouth", 2)
    await world.register(ear, Kind.SUBSCRIPTION, "/secret")
    await world.register(mouth, Kind.PUBLICATION, "/secret")
    world.reload(POLICY.format("", "/secret=\n"))
    world.deliveries.told.clear()
    world.watchlist.could_not_tell(ear, NodeCall("publisherUpdate", ("/secret", [])), "away")
    await world.settle()
    assert world.deliveries.told == [("/ear", "publisherUpdate", ("/secret", []))]


async def test_a_node_whose_every_registration_was_taken_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is away while it has nothing: like any other node it is kept, and gets back what is granted again."""
    monkeypatch.setattr(liveness, "_IDLE_SECONDS", 0.0)
    world = await ControlParts.begun()
    node, idle = world.node("/n", 1), world.node("/idle", 2)
    await world.register(node, Kind.PUBLICATION, "/secret")
    world.reload(POLICY.format("/secret=\n", ""))
    await world.settle()
    world.clients.silent = {"/n", "/idle"}
    await world.look(node)
    await world.look(idle)
    assert world.registry.all() == [node]
    world.reload(OPEN)
    world.clients.silent = set()
    await world.look(node)
    assert world.lives == [Life.LIVE]
    assert world.hidden.has(Kind.PUBLICATION, "/secret") == ["/n"]


@pytest.mark.parametrize("away", [False, True], ids=["there", "away"])
async def test_who_had_a_name_before_gets_nothing_back(away: bool) -> None:
    """Everything was taken from a node, and another life has its name now: a rollback is for that one."""
    world = await ControlParts.begun()
    first, second = world.node("/n", 1), world.node("/n", 2)
    await world.register(first, Kind.PUBLICATION, "/secret")
    world.reload(POLICY.format("/secret=\n", ""))
    await world.settle()
    if away:
        world.clients.silent = {"/n"}
        await world.look(first)
        world.clients.silent = set()
    await world.register(second, Kind.PUBLICATION, "/plain")
    world.reload(OPEN)
    await world.look(first)
    assert world.registry.holder("/n") is second
    assert [one for one in world.registry.live() if one.name == "/n"] == [second]
    assert first.resources(Kind.PUBLICATION) == []
    assert world.hidden.nodes["/n"] == world.faces.inner_uri(second)


async def test_a_node_that_returns_leaves_the_name_to_one_that_everything_was_taken_from() -> None:
    """Who holds a name by what the policy took from it is still who has the name, when all is granted again."""
    world = await ControlParts.begun()
    first, second = world.node("/n", 1), world.node("/n", 2)
    await world.register(first, Kind.PUBLICATION, "/plain")
    world.clients.silent = {"/n"}
    await world.look(first)
    world.clients.silent = set()
    await world.register(second, Kind.PUBLICATION, "/secret")
    world.reload(POLICY.format("/secret=\n", ""))
    await world.settle()
    await world.look(first)
    assert first.life is Life.SHADOW
    world.reload(OPEN)
    await world.settle()
    assert world.registry.holder("/n") is second


async def test_a_node_that_returns_while_it_is_taken_out_is_in_again() -> None:
    """The answer comes in the moment in which ROSMaster is told that the node is lost: nothing of it is left out."""
    world = await ControlParts.begun()
    node = world.node("/n")
    for topic in ("/a", "/b", "/c"):
        await world.register(node, Kind.PUBLICATION, topic)
    world.clients.silent = {"/n"}
    losing = asyncio.ensure_future(world.liveness.look(node))
    while node.life is Life.LIVE:
        await asyncio.sleep(0)
    await world.liveness.revive(node)
    await losing
    await world.settle()
    assert [world.hidden.has(Kind.PUBLICATION, topic) for topic in ("/a", "/b", "/c")] == [["/n"]] * 3


async def test_a_call_of_a_node_that_is_lost_meanwhile_brings_all_of_it_back() -> None:
    """The relays carry what it had, subscribers are told, and ROSMaster has it after the next round."""
    world = await ControlParts.begun()
    node, ear = world.node("/n", 1), world.node("/ear", 2)
    await world.register(ear, Kind.SUBSCRIPTION, "/a")
    await world.register(node, Kind.PUBLICATION, "/a")
    world.clients.silent = {"/n"}
    await world.look(node)
    world.deliveries.told.clear()
    await world.register(node, Kind.PUBLICATION, "/b")
    assert world.relay.returned == ["/n"]
    assert ("/ear", "publisherUpdate", ("/a", [node.outer_uri("10.0.0.1")])) in world.deliveries.told
    await world.round()
    assert world.hidden.has(Kind.PUBLICATION, "/a") == ["/n"]


async def test_a_node_that_returns_while_the_master_is_new_is_told_by_the_rebuild() -> None:
    """Its call goes on: what it had comes with everything else, and the call itself waits at the door."""
    world = await ControlParts.begun()
    node = world.node("/n")
    await world.register(node, Kind.PUBLICATION, "/a")
    world.clients.silent = {"/n"}
    await world.look(node)
    world.rosmaster.shut()
    world.hidden.restart()
    await world.liveness.revive(node)
    assert not world.rosmaster.reachable
    await world.round()
    assert world.hidden.has(Kind.PUBLICATION, "/a") == ["/n"]


async def test_silent_nodes_of_a_host_delay_no_look_at_anothers() -> None:
    """Four hundred and fifty nodes of a guest answer nothing; a robot's node that is dead is lost at the first look."""
    world = await ControlParts.begun()
    silence = asyncio.Event()
    robot = world.node("/robot", 1)
    await world.register(robot, Kind.PUBLICATION, "/t")
    guests = [world.node(f"/guest_{number}", 2 + number) for number in range(450)]
    for guest in guests:
        guest.host = ipaddress.ip_address("10.0.0.66")

    class Silent:
        async def call(self, _method: str, *_params: Value) -> Value:
            await silence.wait()
            return [1, "", 1]

    class Gone:
        async def call(self, _method: str, *_params: Value) -> Value:
            raise RefusedError("nobody is there")

    cast(Any, world.nodes).client = lambda node: Gone() if node is robot else Silent()
    for guest in guests:
        world.liveness.look_at(guest)
    for _ in range(5):
        await asyncio.sleep(0)
    world.liveness.look_at(robot)
    async with asyncio.timeout(5):
        while robot.life is Life.LIVE:
            await asyncio.sleep(0.01)
    silence.set()
    await world.settle()
