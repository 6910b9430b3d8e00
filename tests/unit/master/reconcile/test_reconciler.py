"""The reconcile loop makes ROSMaster what the registry wants, and wants nothing that the policy took."""

import asyncio
from typing import Any, cast

import pytest

from appliance.master.graph.registry import Kind, Registration
from appliance.rpc.xmlrpc_client import CallFailedError
from tests.support.control_parts import POLICY, ControlParts

pytestmark = pytest.mark.anyio
NO_SECRET = POLICY.format("/secret=\n", "/secret=\n")


@pytest.mark.parametrize("kind", [Kind.PUBLICATION, Kind.SUBSCRIPTION])
async def test_what_the_policy_took_is_not_adopted(kind: Kind) -> None:
    """A round that comes before ROSMaster was told of the revocation takes the registration from it, not back."""
    world = ControlParts()
    await world.round()
    node = world.node("/n")
    await world.register(node, kind, "/secret")
    assert world.reload(NO_SECRET) == 1
    await world.round()
    assert (node.resources(kind), list(node.shelf)) == ([], [(kind, "/secret")])
    assert world.hidden.has(kind, "/secret") == []
    await world.settle()
    await world.round()
    assert world.hidden.has(kind, "/secret") == []


async def test_what_was_granted_and_not_written_down_is_adopted() -> None:
    """Control died between ROSMaster's answer and the registry: the node keeps its registration."""
    world = ControlParts()
    await world.round()
    node = world.node("/n")
    await world.register(node, Kind.PUBLICATION, "/first")
    await world.entries.make(node, Registration(Kind.PUBLICATION, "/second", "t", 0))
    await world.round()
    assert node.resources(Kind.PUBLICATION) == ["/first", "/second"]


@pytest.mark.parametrize("kind", [Kind.PUBLICATION, Kind.SUBSCRIPTION])
async def test_what_rosmaster_has_is_no_right(kind: Kind) -> None:
    """A registration that ROSMaster says a node has, and that the policy does not grant, is ended, not adopted."""
    world = await ControlParts.begun()
    node = world.node("/n")
    await world.register(node, kind, "/first")
    world.reload(NO_SECRET)
    await world.entries.make(node, Registration(kind, "/secret", "t", 0))
    await world.round()
    assert node.resources(kind) == ["/first"]
    assert world.hidden.has(kind, "/secret") == []


async def test_a_registration_under_another_name_is_no_nodes() -> None:
    """ROSMaster says that a node has a topic under a name that is not its own: it is ended, and nobody has it."""
    world = await ControlParts.begun()
    node = world.node("/n")
    await world.register(node, Kind.PUBLICATION, "/first")
    forged = ("/m", "/second", "t", world.faces.inner_uri(node))
    await world.rosmaster.call_now("registerPublisher", *forged)
    assert (await world.ask("lookupNode", "/asker", "/m")) == [-1, "unknown node [/m]", ""]
    await world.round()
    assert node.resources(Kind.PUBLICATION) == ["/first"]
    assert world.hidden.has(Kind.PUBLICATION, "/second") == []


async def test_a_parameter_that_was_set_when_control_died_is_told() -> None:
    """A new control finds ROSMaster as it was: subscribers hear the values that it has, whatever was under way."""
    world = ControlParts()
    node = world.node("/n")
    for key in ("/speed", "/unset"):
        world.registry.register(node, Kind.PARAMETER, key, "")
    world.hidden.parameters["speed"] = 2
    await world.round()
    assert world.deliveries.told == [
        ("/n", "paramUpdate", ("/speed/", 2)),
        ("/n", "paramUpdate", ("/unset/", {})),
    ]


async def test_a_parameter_that_changed_while_its_node_was_away_is_told() -> None:
    """What a returned node subscribed to has the value it has now; an unset one is told as ROSMaster tells it."""
    world = ControlParts()
    await world.round()
    node = world.node("/n")
    for key in ("/speed", "/unset", "/"):
        await world.register(node, Kind.PARAMETER, key)
    world.clients.silent = {"/n"}
    await world.look(node)
    world.hidden.parameters["speed"] = 2
    world.clients.silent = set()
    await world.look(node)
    assert world.deliveries.told == [
        ("/n", "paramUpdate", ("/speed/", 2)),
        ("/n", "paramUpdate", ("/unset/", {})),
        ("/n", "paramUpdate", ("/", {"run_id": "1", "speed": 2})),
    ]


async def test_a_parameter_that_is_granted_again_is_told() -> None:
    """The same for a node that could not hear of it because the policy had taken it."""
    world = ControlParts()
    await world.round()
    node = world.node("/n")
    await world.register(node, Kind.PARAMETER, "/speed")
    world.reload(NO_SECRET + "[Parameters]\n")
    await world.settle()
    world.hidden.parameters["speed"] = 2
    world.reload(NO_SECRET)
    await world.settle()
    assert world.deliveries.told == [("/n", "paramUpdate", ("/speed/", 2))]


async def test_a_new_master_is_whole_before_it_is_asked_anything() -> None:
    """A node that returns while ROSMaster is new opens no door to it: the rebuild does, which tells it everything."""
    world = ControlParts(silent=3600.0)
    await world.round()
    node, other = world.node("/n", 1), world.node("/other", 2)
    await world.register(node, Kind.PUBLICATION, "/t")
    await world.register(other, Kind.PUBLICATION, "/u")
    world.rosmaster.shut()
    world.hidden.restart()
    with pytest.raises(CallFailedError):
        await world.entries.put_back(node, list(node.registrations.values()))
    assert (world.rosmaster.reachable, world.rosmaster.doubtful.is_set()) == (False, True)
    await world.round()
    assert (world.rosmaster.reachable, world.entries.pid) == (True, world.hidden.pid)
    assert [world.hidden.has(Kind.PUBLICATION, topic) for topic in ("/t", "/u")] == [["/n"], ["/other"]]


class _Patient:
    """The hidden ROSMaster, which answers `method` when `many` of these calls are under way."""

    def __init__(self, world: ControlParts, method: str, many: int) -> None:
        self._hidden, self._method, self._many = world.hidden, method, many
        self.told: list[Any] = []
        self._all = asyncio.Event()
        world.rosmaster.calls = cast(Any, self)

    async def call(self, method: str, *params: Any) -> Any:
        """One call."""
        if method == self._method:
            self.told.append(params[1])
            if len(self.told) == self._many:
                self._all.set()
            await self._all.wait()
        return await self._hidden.call(method, *params)


async def test_a_new_master_is_told_without_waiting_for_each_answer() -> None:
    """Everybody waits at the door meanwhile: thousands of registrations are not thousands of round trips."""
    world = ControlParts()
    await world.round()
    node = world.node("/n")
    names = [f"/t{number}" for number in range(40)]
    for name in reversed(names):
        await world.register(node, Kind.PUBLICATION, name)
    world.hidden.restart()
    master = _Patient(world, "registerPublisher", len(names))
    async with asyncio.timeout(60):
        await world.round()
    assert master.told == names[::-1]


async def test_what_is_left_of_a_lost_node_is_ended_without_waiting_for_each_answer() -> None:
    """The same for thousands of registrations that nobody has any more."""
    world = ControlParts()
    await world.round()
    gone = world.faces.inner_uri(world.node("/n"))
    for number in range(40):
        await world.hidden.call("registerPublisher", "/gone", f"/t{number}", "t", gone)
    _Patient(world, "unregisterPublisher", 40)
    async with asyncio.timeout(60):
        await world.round()
    assert not any(world.hidden.tables[Kind.PUBLICATION].values())


async def test_a_node_that_returns_is_put_back_without_waiting_for_each_answer() -> None:
    """The same for what it had; it is registered in the order in which it did."""
    world = ControlParts(silent=3600.0)
    await world.round()
    node = world.node("/n")
    names = [f"/t{number}" for number in range(40)]
    for name in names:
        await world.register(node, Kind.PUBLICATION, name)
    master = _Patient(world, "registerPublisher", len(names))
    async with asyncio.timeout(60):
        await world.entries.put_back(node, node.in_order())
    assert master.told == names


async def test_a_look_at_rosmaster_is_no_trouble() -> None:
    """Calls wait for the moment of a round, and status does not say that ROSMaster is rebuilt, unless it is."""
    world = ControlParts()
    seen: list[tuple[str, bool, bool]] = []
    call = world.hidden.call

    async def watched(method: str, *params: Any) -> Any:
        seen.append((method, world.rosmaster.reachable, world.rosmaster.whole))
        return await call(method, *params)

    world.hidden.call = watched  # type: ignore[method-assign]  # the same ROSMaster, looked at
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
