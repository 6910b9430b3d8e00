"""Any host may have registered names at the robot's own master, and one node may be slow: others are served."""

import pytest

from appliance.base import clock
from appliance.features.adopt.adopt_record import Phase
from appliance.features.adopt.takeover import AdoptError
from roswire.uris import NodeUri
from roswire.xmlrpc import Value
from tests.unit.features.adopt.robot_world import LINK, RobotWorld
from tests.unit.features.adopt.test_takeover import require_taken

pytestmark = pytest.mark.anyio
STRANGER = "10.0.0.66"
ODD = (
    "odd", "http://[::1]:1/", f"http://{STRANGER}:1/%s%d%", "http://base:22/", "http://base:11311/", "http://:0/",
    "http://localhost:4001/%", "http://203.0.113.9:80/",
)  # fmt: skip


def _fill(world: RobotWorld, silent: int, unknown: int) -> None:
    """Register names of an unknown host that come first in each order."""
    uris = [f"http://{STRANGER}:{20_000 + number}/" for number in range(silent)]
    uris += [f"http://a{number}.invalid:4000/" for number in range(unknown)]
    for number, uri in enumerate((*uris, *ODD)):
        world.master.entries.add(("publication", f"/a%s{number}", f"/a%{number}"))
        world.master.nodes[f"/a%{number}"] = uri
    world.master.nodes = dict(sorted(world.master.nodes.items()))
    world.silent_host = STRANGER


@pytest.mark.parametrize("ordered", [False, True], ids=["at a start", "by an order"])
@pytest.mark.parametrize(("silent", "unknown"), [(300, 0), (0, 520), (300, 520)])
async def test_the_robots_nodes_are_taken_in_seconds_beside_names_of_an_unknown_host(
    world: RobotWorld, silent: int, unknown: int, ordered: bool
) -> None:
    world.connected = {4001, 4002, 4003}
    world.add("/nuc", 4004, uri="http://192.168.50.2:4004/", publishes=("/nuc",))
    _fill(world, silent, unknown)
    began = clock.now()
    await (world.operation.adopt() if ordered else world.operation.take())
    assert clock.now() - began < 20
    assert {name for _kind, _resource, name in world.truth()} <= {
        name for _kind, _resource, name in world.adopted()
    }
    assert len([name for name in world.operation.left.nodes if name.startswith("/a%")]) >= silent + unknown


async def test_a_start_takes_nothing_while_a_node_of_this_computer_is_silent(world: RobotWorld) -> None:
    """The graph stays as it is, and is taken when the node answers."""
    world.connected = {4001, 4002, 4003}
    world.robot["/teleop"].hangs = True
    entries = {*world.master.entries}
    with pytest.raises(AdoptError, match=r"1 node of this computer cannot be called: /teleop: .*4002"):
        await world.operation.take()
    assert (world.record.phase, world.forwarded, world.adopted()) == (Phase.FREE, False, set())
    assert world.master.entries == entries
    world.robot["/teleop"].hangs = False
    await world.until_settled()
    require_taken(world)


async def test_an_order_takes_the_others_while_a_node_of_this_computer_is_silent(world: RobotWorld) -> None:
    world.connected = {4001, 4002, 4003}
    world.robot["/teleop"].hangs = True
    report = await world.operation.adopt()
    assert report.missing.keys() == {"/teleop"}
    assert world.record.phase is Phase.TAKEN


@pytest.mark.parametrize("uri", ["http://base:5001/", "http://base:5001/%s", "http://127.0.0.1:5002/"])
async def test_a_name_with_another_port_of_a_node_keeps_no_start_from_taking(
    world: RobotWorld, uri: str
) -> None:
    world.connected = {4001, 4002, 4003}
    world.master.entries.add(("publication", "/x", "/a"))
    world.master.nodes["/a"] = uri
    await world.operation.take()
    assert world.record.phase is Phase.TAKEN
    assert world.operation.left.nodes.keys() == {"/a"}


async def test_the_connections_of_a_publisher_that_does_not_tell_its_port_are_cut_or_named(
    world: RobotWorld,
) -> None:
    """On this computer its process is known; on another one it is asked again, and then cut."""
    for name, port, uri in (("/slow", 4005, ""), ("/nuc", 4006, "http://192.168.50.2:4006/")):
        world.add(name, port, uri=uri, publishes=("/chatter",)).tells = "nothing"
    await world.until_settled()
    assert 5005 in world.cuts[-1]
    assert ("192.168.50.2", 5006) not in world.remote
    assert world.operation.left.not_cut.keys() == {"/nuc"}
    world.robot["/nuc"].tells = "port"
    await world.operation.settle(await world.operation.facts(), settled=True)
    assert ("192.168.50.2", 5006) in world.remote
    assert world.operation.left.not_cut == {}


async def test_a_topic_that_an_unknown_host_registered_for_a_node_hides_no_port(world: RobotWorld) -> None:
    world.robot["/teleop"].tells = "refusal"
    for number in range(500):
        world.master.entries.add(("publication", f"/a{number}", "/teleop"))
    await world.operation.take()
    assert 5002 in world.cuts[-1]


async def test_a_port_is_cut_as_a_service_only_if_a_service_answers_there(world: RobotWorld) -> None:
    """Any host may have registered services for a node: other ports of its machine keep their connections."""
    world.add("/nuc", 4004, uri="http://192.168.50.2:4004/", publishes=("/nuc",))
    world.add("/calls", 4005, uri="http://192.168.50.2:4005/", services=("/calls",))
    world.devices = {2112}
    for port in (2112, *range(10_000, 10_050)):
        world.master.entries.add(("service", f"/a{port}", "/nuc"))
        world.master.services[f"/a{port}"] = f"rosrpc://192.168.50.2:{port}"
    await world.until_settled()
    assert {tuple(row) for row in world.remote} == {("192.168.50.2", 5004), ("192.168.50.2", 5005)}
    assert world.operation.left.not_cut.keys() == {"192.168.50.2 TCP 2112"}
    for port in range(20_000, 20_500):
        world.master.entries.add(("service", f"/b{port}", "/nuc"))
        world.master.services[f"/b{port}"] = f"rosrpc://192.168.50.2:{port}"
    world.probed.clear()
    await world.operation.take()
    assert len(world.probed) <= 64 + 1, "registered services make the appliance scan no ports"


@pytest.mark.parametrize("wanted", [True, False], ids=["adopted", "released"])
async def test_a_node_gets_a_new_clock_only_after_it_has_read_the_earlier_one(
    world: RobotWorld, wanted: bool
) -> None:
    world.add("/gazebo", 4004, publishes=("/clock",))
    sleeper = world.add("/sleeper", 4005, subscribes=("/clock", "/odom"), keeps=True)
    quick = world.add("/quick", 4006, subscribes=("/clock",))
    sleeper.lags = 20
    await world.until_settled()
    assert sleeper.lists["/clock"]
    if not wanted:
        await world.release()
        assert sleeper.lists["/clock"] == [world.robot["/gazebo"].uri]
    assert "/clock" not in sleeper.heard_both
    assert quick.connected["/clock"]


async def test_a_node_that_never_tells_of_its_clock_delays_no_other_and_is_named(world: RobotWorld) -> None:
    world.add("/gazebo", 4004, publishes=("/clock",))
    sleeper = world.add("/sleeper", 4005, subscribes=("/clock",))
    sleeper.lags = 100_000
    began = clock.now()
    await world.until_settled()
    assert clock.now() - began < 15
    assert world.record.phase is Phase.TAKEN
    assert [name for name in world.operation.left.not_cut if name == "/sleeper /clock"]
    assert sleeper.lists["/clock"], "it has a clock nevertheless"


async def test_ports_of_a_host_that_an_unknown_host_registered_are_not_scanned(world: RobotWorld) -> None:
    world.add("/nuc", 4004, uri="http://192.168.50.2:4004/", publishes=("/nuc",))
    for number in range(500):
        world.master.entries.add(("publication", "/x", f"/x{number}"))
        world.master.nodes[f"/x{number}"] = f"http://192.168.50.2:{10_000 + number}/"
    asked = _asked(world)
    await world.operation.take()
    assert len([uri for uri, _method in asked if uri.port >= 10_000]) < 100
    assert "/nuc" in {name for _kind, _resource, name in world.adopted()}


def _asked(world: RobotWorld) -> list[tuple[NodeUri, str]]:
    """Return a list that grows with each call of a node."""
    asked: list[tuple[NodeUri, str]] = []
    call = world.operation.call

    async def noted(uri: NodeUri, method: str, /, *params: Value) -> Value:
        asked.append((uri, method))
        return await call(uri, method, *params)

    world.operation.call = noted
    return asked


async def test_two_names_of_one_place_are_asked_once(world: RobotWorld) -> None:
    for number in range(20):
        world.master.entries.add(("publication", "/x", f"/also{number}"))
        world.master.nodes[f"/also{number}"] = world.robot["/base"].uri
    asked = _asked(world)
    await world.operation.take()
    assert [method for _uri, method in asked].count("getPid") == 3
    assert {str(node.host) for node in world.graph.nodes()} == {LINK}
