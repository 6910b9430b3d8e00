"""The reconcile loop makes ROSMaster what the registry wants, and wants nothing that the policy took."""

import pytest

from appliance.master.graph.registry import Kind, Registration
from appliance.rpc.client import CallFailedError
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
