import asyncio
import copy
from collections.abc import Callable, Coroutine
from typing import Any, cast
from unittest.mock import MagicMock

import msgspec
import pytest

from appliance.base import clock
from appliance.control.core import Core
from appliance.features.adopt.adopt_record import Phase
from appliance.features.adopt.control_part import AdoptPart
from appliance.features.adopt.machine_facts import RobotMaster
from appliance.features.adopt.requests import AdoptOrder
from appliance.features.adopt.takeover import AdoptError
from appliance.master.graph.registry import Kind
from roswire.parameter_tree import same_value
from roswire.uris import NodeUri
from roswire.xmlrpc import Value
from tests.support.engines import KilledError
from tests.unit.features.adopt.robot_world import LINK, RobotWorld

pytestmark = pytest.mark.anyio
MANY = 10_000
TAKE = (
    "read", "parameters", "register", "forward", "connect", "tell", "cut", "read again", "hidden", "taken",
)  # fmt: skip
GIVE = ("silence", "stand in", "give", "withdraw", "give again", "tell", "given", "forget", "released")


def require_taken(world: RobotWorld) -> None:
    assert world.record.phase is Phase.TAKEN
    assert world.forwarded
    assert world.adopted() == world.truth()
    assert {str(node.host) for node in world.graph.nodes()} == {LINK}
    for node in world.robot.values():
        for topic in node.subscribes:
            assert node.lists[topic], f"{node.name} has no list of {topic}"
            assert all("10.0.0.1" in uri for uri in node.lists[topic]), "the appliance's own address"
    require_hearing(world)


def require_given(world: RobotWorld) -> None:
    assert world.record.phase is Phase.FREE
    assert not world.forwarded
    assert world.graph.nodes() == []
    assert world.master.entries == world.truth()
    assert world.master.shutdowns == [], "no node gets a shutdown request"
    for node in world.robot.values():
        for topic in node.subscribes if node.alive else ():
            expected = [one.uri for one in world.robot.values() if topic in one.publishes and one.alive]
            assert sorted(node.lists[topic]) == sorted(expected), (
                f"the last list of {node.name} is the master's own"
            )
    require_hearing(world)


def require_hearing(world: RobotWorld) -> None:
    """Each subscriber has a connection to each publisher of its list, and no other."""
    world.connect_all()
    for node in world.robot.values():
        for topic in node.subscribes if node.alive else ():
            expected = {uri: True for uri in node.lists[topic] if uri != node.uri}
            assert node.links.get(topic, {}) == expected, f"{node.name} is deaf on {topic}"


@pytest.mark.parametrize("slow", [False, True])
async def test_a_running_graph_is_taken_over_and_given_back_again_and_again(
    world: RobotWorld, slow: bool
) -> None:
    slow_down(world, slow)
    for _ in range(3):
        world.steps.clear()
        world.record = msgspec.structs.replace(world.record, wanted=True)
        await world.until_settled()
        require_taken(world)
        await world.release()
        require_given(world)
        assert tuple(world.steps) == TAKE + GIVE


async def test_kills_in_the_middle_of_both_change_nothing_of_the_end(world: RobotWorld) -> None:
    world.killed_after = "cut"
    await world.until_settled()
    require_taken(world)
    world.record = msgspec.structs.replace(world.record, wanted=False)
    world.killed_after = "withdraw"
    await world.until_settled()
    require_given(world)


SLOW = pytest.mark.parametrize("slow", [False, True], ids=["", "slow"])
"""Whether subscribers are still connecting when the next list comes."""


def slow_down(world: RobotWorld, slow: bool) -> None:
    for node in world.robot.values():
        node.slow = slow


@SLOW
@pytest.mark.parametrize("step", TAKE)
async def test_a_kill_after_any_step_of_taking_ends_in_a_taken_graph(
    world: RobotWorld, step: str, slow: bool
) -> None:
    """No subscriber is deaf then, and none after a release."""
    slow_down(world, slow)
    world.killed_after = step
    await world.until_settled()
    require_taken(world)
    assert world.graph.subscribers.unasked == set(world.graph.nodes())
    await world.release()
    require_given(world)


@SLOW
@pytest.mark.parametrize("step", TAKE)
async def test_a_kill_after_any_step_of_taking_can_be_released(
    world: RobotWorld, step: str, slow: bool
) -> None:
    slow_down(world, slow)
    world.killed_after = step
    with pytest.raises(KilledError):
        await world.operation.take()
    world.begin()
    await world.release()
    if step in {"read", "parameters"}:  # nothing was registered, and no node got a list
        assert not world.forwarded
        assert world.master.entries == world.truth()
        assert world.graph.nodes() == []
    else:
        require_given(world)


@pytest.mark.parametrize("wanted", [True, False], ids=["", "released"])
@pytest.mark.parametrize("registrations", range(1, 10))
async def test_a_kill_between_two_registrations_loses_nothing(
    world: RobotWorld, registrations: int, wanted: bool
) -> None:
    world.orders_until_kill = registrations
    with pytest.raises(KilledError):
        await world.operation.take()
    world.begin()
    world.record = msgspec.structs.replace(world.record, wanted=wanted)
    await world.until_settled()
    if wanted:
        require_taken(world)
        assert world.graph.subscribers.unasked == set(world.graph.nodes())
    else:
        require_given(world)


@SLOW
@pytest.mark.parametrize("step", GIVE)
@pytest.mark.parametrize("wanted", [False, True], ids=["release", "stop"])
async def test_a_kill_after_any_step_of_giving_back_ends_as_the_record_wants(
    world: RobotWorld, step: str, wanted: bool, slow: bool
) -> None:
    slow_down(world, slow)
    await world.until_settled()
    world.record = msgspec.structs.replace(world.record, wanted=wanted)
    world.killed_after = step
    with pytest.raises(KilledError):
        await world.operation.give()
    world.begin()
    await world.release()
    require_given(world)


@pytest.mark.parametrize("topics", [1, 16, 40])
@pytest.mark.parametrize("where", ["here", "one host", "many hosts"])
async def test_nodes_that_hang_delay_no_node_of_this_computer(
    bare: RobotWorld, where: str, topics: int
) -> None:
    subscribed = tuple(f"/t{number}" for number in range(topics))
    for number in range(1 if where == "here" else 20):
        host = "base" if where == "here" else f"nuc{number if where == 'many hosts' else 0}"
        if where != "here":
            bare.resolved.setdefault(host, [f"192.168.50.{100 + len(bare.resolved)}"])
        uri = f"http://{host}:{4100 + number}/"
        bare.add(
            f"/a_recorder{number}", 4100 + number, uri, publishes=("/a_diagnosis",), subscribes=subscribed
        )
    bare.add_nodes()
    await bare.until_settled()
    hanging = [node for node in bare.robot.values() if node.name.startswith("/a_recorder")]
    for node in hanging:
        node.hangs = True
    report = await bare.operation.release()
    assert report.failed == sorted(node.name for node in hanging)
    assert report.seconds < 9
    for node in hanging:
        del bare.robot[node.name]
    require_hearing(bare)
    assert bare.robot["/rviz"].lists["/odom"] == [bare.robot["/base"].uri]


async def test_a_dead_connection_to_a_publisher_leaves_no_subscriber_deaf_after_the_release(
    world: RobotWorld,
) -> None:
    """roscpp says that it is connected, and a list with that publisher changes nothing."""
    await world.until_settled()
    world.robot["/teleop"].links["/odom"][world.robot["/base"].uri] = False
    await world.release()
    require_given(world)


@pytest.mark.parametrize("killed", [False, True])
async def test_a_release_ends_nothing_that_was_not_adopted(world: RobotWorld, killed: bool) -> None:
    """A node that cannot be adopted keeps its registrations, and a parameter that a limit left out its value."""
    world.add("/far", 4010, uri="http://nuc:4010/", publishes=("/scan",))
    world.limit = "speed"
    report = await world.operation.take()
    assert report.left_out == ["parameter /speed: too large"]
    if killed:
        world.begin()
        report = await world.operation.take()
    assert "add it to /etc/hosts" in report.missing["/far"]
    await world.release()
    assert ("publication", "/scan", "/far") in world.master.entries
    assert world.master.tree["speed"] == 1.5


@pytest.mark.parametrize(
    ("name", "value"),
    [("", {"x": 1}), ("", 5), ("/speed", 2), ("speed/max", 2), ("~a", 1), ("ns", {"/speed": 2})],
)
async def test_a_name_that_a_plain_master_cannot_find_changes_no_other_parameter(
    world: RobotWorld, name: str, value: Value
) -> None:
    """Any host may have written it there, before the appliance came."""
    world.master.tree[name] = value
    before = dict(world.master.tree)
    report = await world.operation.take()
    assert len(report.left_out) == 1
    assert world.tree() == {"run_id": "robot", "speed": 1.5}
    await world.release()
    assert world.master.tree == before


@pytest.mark.parametrize(
    ("before", "now"), [(1, True), (0, False), (1, 1.0), ([1], [1.0]), ({"a": 1}, {"a": True})]
)
async def test_a_parameter_that_only_changed_its_type_is_given_back(
    world: RobotWorld, before: Value, now: Value
) -> None:
    world.master.tree["speed"] = before
    await world.operation.take()
    await world.parts.ask("setParam", "/tool", "/speed", now, host=LINK)
    await world.release()
    assert same_value(world.master.tree["speed"], now)


def control_part(world: RobotWorld) -> AdoptPart:
    part = object.__new__(AdoptPart)
    part._operation, part._one, part._settled, part._facts = world.operation, asyncio.Lock(), False, None
    part._core, part._obstacle = cast(Core, MagicMock(trail=world.parts.records)), ""
    part._save = lambda: None  # type: ignore[method-assign]  # nothing is stored here
    return part


def apart(world: RobotWorld, work: Coroutine[Any, Any, Any]) -> "asyncio.Task[Any]":
    """Begin a task for which `ControlParts.settle` does not wait."""
    task = asyncio.create_task(work)
    world.parts._not_ours.add(task)
    return task


async def stop_during(world: RobotWorld, taking: "asyncio.Task[Any]", part: AdoptPart) -> float:
    """Return the seconds that an ordered stop takes."""
    began = clock.now()
    await part.before_end()
    seconds = clock.now() - began
    await asyncio.gather(taking, return_exceptions=True)
    await settle_once(part)  # the record still wants the graph of a start
    require_given(world)
    return seconds


async def settle_once(part: AdoptPart) -> None:
    async with part._one:
        await part._settle()


@pytest.mark.parametrize("step", TAKE)
@pytest.mark.parametrize("order", [False, True], ids=["start", "order"])
async def test_an_ordered_end_after_any_step_of_taking_ends_in_a_given_graph(
    world: RobotWorld, step: str, order: bool
) -> None:
    part, reached = control_part(world), asyncio.Event()

    async def reach() -> None:
        reached.set()
        await asyncio.sleep(0)

    do_after(world, step, reach)
    world.record = msgspec.structs.replace(world.record, wanted=not order)
    taking = apart(world, part.adopt(AdoptOrder()) if order else settle_once(part))
    await reached.wait()
    await stop_during(world, taking, part)


@pytest.mark.parametrize("seconds", [0.1, 1.0, 2.0, 3.0, 6.0, 7.0, 9.0])
async def test_an_ordered_end_waits_for_no_node_that_is_asked(world: RobotWorld, seconds: float) -> None:
    part = control_part(world)
    world.silent_host, world.resolved["laptop"] = "192.168.50.9", ["192.168.50.9"]
    for number in range(3):
        world.add(f"/far{number}", 5000 + number, f"http://laptop:{5000 + number}/", publishes=("/far",))
    call = world.operation.call

    async def slow(uri: NodeUri, method: str, /, *params: Value) -> Value:
        await asyncio.sleep(4.0 * (method == "requestTopic"))
        return await call(uri, method, *params)

    world.operation.call = slow
    taking = apart(world, settle_once(part))
    await asyncio.sleep(seconds)
    assert await stop_during(world, taking, part) < 1


@pytest.mark.parametrize("registrations", range(1, 10))
async def test_an_ordered_end_between_two_registrations_loses_nothing(
    world: RobotWorld, registrations: int
) -> None:
    part, ask, ends = control_part(world), world.parts.ask, list[asyncio.Task[None]]()

    async def slow(method: str, *params: Value, **more: Any) -> Any:
        if len(world.began) == registrations:
            ends.append(apart(world, part.before_end()))
            await asyncio.sleep(0.1)
        return await ask(method, *params, **more)

    world.parts.ask = slow  # type: ignore[method-assign]  # the only way into a step
    await settle_once(part)
    await asyncio.wait(ends)
    require_given(world)


def do_after(world: RobotWorld, step: str, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Do this once, after the step."""
    passed, waits = world.operation.passed, [work]

    async def then(now: str) -> None:
        if now == step and waits:
            await waits.pop()()
        await passed(now)

    world.operation.passed = then


WRITES: dict[str, tuple[str, Value]] = {
    "set": ("/new", 7),
    "set a namespace": ("/new_node", {"max_vel": 0.3}),
    "set in a namespace": ("/base/new", 7),
    "change": ("/speed", 0.5),
    "change in a namespace": ("/base/max", 0.5),
    "delete": ("/speed", None),
    "delete in a namespace": ("/base/min", None),
}


def write(tree: dict[str, Any], name: str, value: Value) -> None:
    *spaces, last = name.strip("/").split("/")
    for space in spaces:
        tree = tree[space]
    tree.pop(last) if value is None else tree.update({last: value})


@pytest.mark.parametrize("kind", WRITES)
@pytest.mark.parametrize(
    ("step", "release"),
    [(step, False) for step in TAKE[: TAKE.index("cut")]]
    + [(step, True) for step in GIVE[: GIVE.index("withdraw")]],
)
async def test_no_parameter_that_is_written_during_an_adoption_or_a_release_is_lost(
    world: RobotWorld, step: str, release: bool, kind: str
) -> None:
    """Until the cut, nodes write at the robot's own master, and until the withdrawal at RVMaster."""
    name, value = WRITES[kind]
    world.master.tree["base"] = {"max": 1.5, "min": 0.1}
    expected = copy.deepcopy(world.master.tree)
    write(expected, name, value)

    async def node_writes() -> None:
        if not release:
            write(world.master.tree, name, value)
        elif value is None:
            await world.parts.ask("deleteParam", "/tool", name, host=LINK)
        else:
            await world.parts.ask("setParam", "/tool", name, value, host=LINK)

    do_after(world, step, node_writes)
    await world.until_settled()
    if not release:
        assert world.tree() == expected
    assert world.tree() == world.master.tree
    await world.release()
    assert world.tree() == world.master.tree == expected


async def test_a_later_value_at_the_appliance_replaces_that_of_the_own_master(world: RobotWorld) -> None:
    world.master.tree["base"] = {"max": 1.5, "min": 0.1}

    async def both_write() -> None:
        world.master.tree["base"] = {"max": 0.5, "min": 0.2}
        await world.parts.ask("setParam", "/tool", "/base/max", 0.7, host=LINK)

    do_after(world, "forward", both_write)
    await world.until_settled()
    assert world.tree()["base"] == {"max": 0.7, "min": 0.2}
    await world.release()
    assert world.master.tree["base"] == {"max": 0.7, "min": 0.2}


@pytest.mark.parametrize("step", ["parameters", "register", "forward"])
async def test_an_adoption_that_fails_leaves_what_was_written_at_the_own_master(
    world: RobotWorld, step: str
) -> None:
    async def write_and_die() -> None:
        world.master.tree["speed"] = 0.5
        world.master.alive = False

    do_after(world, step, write_and_die)
    world.record = msgspec.structs.replace(world.record, wanted=False)
    with pytest.raises(AdoptError):
        await world.operation.adopt()
    world.master.alive = True
    await world.until_settled()
    assert world.master.tree == {"run_id": "robot", "speed": 0.5}


async def test_a_graph_that_was_not_yet_taken_over_loses_no_node_that_came_in_the_meantime(
    world: RobotWorld,
) -> None:
    world.killed_after = "cut"
    with pytest.raises(KilledError):
        await world.operation.take()
    world.add("/late", 4009, publishes=("/late",))
    world.begin()
    await world.release()
    assert ("publication", "/late", "/late") in world.master.entries


async def test_a_master_that_dies_while_it_is_read_leaves_the_robot_as_it_was(world: RobotWorld) -> None:
    world.master.alive = False
    with pytest.raises(AdoptError, match="cannot be read"):
        await world.operation.take()
    assert not world.forwarded
    assert world.cuts == []
    world.master.alive = True
    await world.until_settled()
    require_taken(world)


async def test_a_master_that_dies_after_the_rules_came_does_not_open_them(world: RobotWorld) -> None:
    world.master.before = lambda: setattr(world.master, "alive", not world.forwarded)
    with pytest.raises(AdoptError):
        await world.operation.take()
    assert world.forwarded
    assert world.record.phase is Phase.TAKING


async def test_a_node_that_starts_during_the_reading_is_taken_over(world: RobotWorld) -> None:
    def start() -> None:
        if world.forwarded and "/late" not in world.robot:
            world.add("/late", 4009, publishes=("/scan",), subscribes=("/odom",))

    world.master.before = start
    await world.until_settled()
    assert "/late" in world.robot
    require_taken(world)


async def test_a_registration_that_ends_during_the_reading_is_forgotten(world: RobotWorld) -> None:
    def leave() -> None:
        if world.forwarded and world.robot["/rviz"].subscribes:
            world.robot["/rviz"].subscribes = ()
            world.master.entries.discard(("subscription", "/odom", "/rviz"))

    world.master.before = leave
    await world.until_settled()
    require_taken(world)


async def test_an_order_is_recorded_as_the_operators_and_a_start_as_the_appliances(world: RobotWorld) -> None:
    await world.until_settled()
    await world.operation.release()
    await world.operation.adopt()
    seen = [
        (record.event, record.detail.get("who"))
        for record in world.parts.records.records
        if record.event in {"graph adopted", "graph released"}
    ]
    assert seen == [("graph adopted", None), ("graph released", "operator"), ("graph adopted", "operator")]


def _keep_changing(world: RobotWorld) -> None:
    numbers = iter(range(100))
    world.master.before = lambda: world.master.entries.add(("publication", f"/{next(numbers)}", "/base"))


async def test_a_graph_that_never_rests_is_an_error_after_five_readings(world: RobotWorld) -> None:
    _keep_changing(world)
    with pytest.raises(AdoptError, match="still changes after 5"):
        await world.operation.take()


@pytest.mark.parametrize("fault", ["master", "restless"])
@pytest.mark.parametrize("wanted", [False, True])
async def test_an_order_that_fails_has_no_later_effect(world: RobotWorld, fault: str, wanted: bool) -> None:
    world.record = msgspec.structs.replace(world.record, wanted=wanted)
    if fault == "master":
        world.master.alive = False
    else:
        _keep_changing(world)
    with pytest.raises(AdoptError):
        await world.operation.adopt()
    assert world.record.wanted is wanted
    if not wanted:
        world.master.alive = True
        assert await world.operation.settle(await world.operation.facts(), settled=False) is None
        assert (world.record.phase, world.forwarded) == (Phase.FREE, False)
        assert world.graph.nodes() == []
        assert world.master.entries >= world.truth()


async def test_publishers_come_before_services_and_services_before_subscribers(world: RobotWorld) -> None:
    await world.until_settled()
    order = ["registerPublisher", "registerService", "registerSubscriber"]
    places = [order.index(method) for method in world.began if method in order]
    assert places == sorted(places)
    assert set(places) == {0, 1, 2}


@pytest.mark.parametrize(
    "uri", ["http://base:4001/", "http://192.168.50.1:4001/", "http://192.168.50.1:4001"]
)
async def test_the_uri_of_a_node_stays_as_it_is(bare: RobotWorld, uri: str) -> None:
    bare.add("/node", 4001, uri=uri, publishes=("/odom",), subscribes=("/odom",))
    await bare.until_settled()
    await bare.release()
    assert bare.master.nodes == {"/node": uri}
    require_given(bare)


async def test_hostile_names_and_uris_cost_their_own_rows_only(world: RobotWorld) -> None:
    for number, uri in enumerate(
        ["", "http://base:99999/", "rosrpc://base:1", "http://a\x00b:1/", "x" * 9000]
    ):
        world.master.nodes[f"/bad{number}"] = uri
        world.master.entries.add(("publication", f"/bad{number}", f"/bad{number}"))
    for name in ("/a b", "/\x1b[31m", "bad//", "/base\n", "~"):
        world.master.nodes[name] = world.robot["/base"].uri
        world.master.entries.add(("publication", name, name))
        world.master.entries.add(("publication", name, "/base"))
    report = await world.operation.take()
    assert {f"/bad{number}" for number in range(1, 5)} <= report.missing.keys()
    assert world.truth() <= world.adopted()
    assert all(text.isprintable() for text in report.denied.values())


@pytest.mark.nightly
async def test_ten_thousand_registrations_are_taken_over(bare: RobotWorld) -> None:
    bare.add("/many", 4004, publishes=tuple(f"/t{number}" for number in range(MANY)))
    report = await bare.operation.take()
    assert report.registrations == MANY


async def test_a_denied_registration_is_reported_and_stays_with_the_own_master(world: RobotWorld) -> None:
    world.parts.reload(
        "[Nodes]\ndefault=*\n[Publishers]\n/cmd_vel = 10.9.9.9\ndefault=*\n[Subscribers]\ndefault=*\n"
        "[Commands]\ndefault=*\n"
    )
    report = await world.operation.take()
    assert list(report.denied) == ["publication /cmd_vel /teleop"]
    assert ("publication", "/cmd_vel", "/teleop") not in world.adopted()
    await world.release()
    assert world.master.entries == world.truth()


async def test_the_rosout_of_the_robot_is_skipped_silently(world: RobotWorld) -> None:
    world.add("/rosout", 4005, publishes=("/rosout_agg",), subscribes=("/rosout",))
    report = await world.operation.take()
    assert report.denied == {}
    assert report.missing == {}
    await world.release()
    assert world.master.entries == world.truth()


async def test_a_node_keeps_its_connections_until_the_new_ones_stand(world: RobotWorld) -> None:
    """roscpp ends a connection as soon as a list lacks its publisher, and connects to a new one only later."""

    def lists() -> dict[tuple[str, str], set[str]]:
        return {(one.name, topic): {*one.lists[topic]} for one in world.robot.values() for topic in one.lists}

    connecting: dict[tuple[str, str], set[str]] = {}
    world.after["connect"] = lambda: connecting.update(lists())
    await world.until_settled()
    adopted = lists()
    own = {
        (one.name, topic): {other.uri for other in world.robot.values() if topic in other.publishes}
        for one in world.robot.values()
        for topic in one.subscribes
    }
    assert own == {row: connecting[row] - adopted[row] for row in own}
    assert all(connecting[row] >= adopted[row] for row in own)
    await world.release()
    for (name, topic), uris in own.items():
        given = [{*found} for about, found in world.robot[name].earlier if about == topic]
        own_first = [adopted[name, topic], adopted[name, topic] | uris]
        assert given == [*own_first, uris, uris], "once more after connections to the appliance ended"


async def test_no_node_hears_simulated_time_on_two_connections(world: RobotWorld) -> None:
    """Time would go back then, which ends a rospy node that sleeps."""
    topics = ("/clock", "/odom")
    world.add("/gazebo", 4004, publishes=("/clock",))
    sleepers = [
        world.add("/rospy", 4005, subscribes=topics, keeps=True),
        world.add("/roscpp", 4006, subscribes=topics),
    ]
    for _ in range(2):
        world.record = msgspec.structs.replace(world.record, wanted=True)
        await world.until_settled()
        require_taken(world)
        await world.release()
        require_given(world)
    assert [sleeper.most for sleeper in sleepers] == [{"/clock": 1, "/odom": 2}] * 2


@pytest.mark.parametrize("fails", [1, 2])
async def test_a_node_without_a_clock_after_the_release_gets_its_list_again(
    world: RobotWorld, fails: int
) -> None:
    gazebo = world.add("/gazebo", 4004, publishes=("/clock",))
    sleeper = world.add("/sleeper", 4005, subscribes=("/clock",))
    await world.until_settled()
    sleeper.fails = fails
    await world.release()
    require_given(world)
    assert sleeper.connected == {"/clock": [gazebo.uri]}


async def test_a_node_that_does_not_connect_after_the_release_gets_its_list_again(world: RobotWorld) -> None:
    await world.until_settled()
    world.robot["/rviz"].fails = 2  # both lists of the release
    await world.release()
    require_given(world)
    assert world.robot["/rviz"].connected == {"/odom": [world.robot["/base"].uri]}
    assert len(world.robot["/rviz"].earlier) == len(world.robot["/teleop"].earlier) + 1


async def test_another_master_than_the_recorded_one_is_refused(world: RobotWorld) -> None:
    world.holder = RobotMaster(9, "/tmp/rosmaster", "nobody")
    with pytest.raises(AdoptError, match="is not the recorded master"):
        await world.operation.take()
    assert not world.forwarded
    assert world.began == []


async def test_each_change_of_a_parameter_reaches_every_adopted_node(world: RobotWorld) -> None:
    await world.until_settled()
    assert world.tree()["speed"] == 1.5
    world.parts.seen.clear()
    world.parts.deliveries.told.clear()
    await world.parts.ask("setParam", "/tool", "/limit", {"speed": 9.9}, host=LINK)
    told = {
        (name, params[0]) for name, method, params in world.parts.deliveries.told if method == "paramUpdate"
    }
    assert told == {(name, key) for name in world.robot for key in ("/limit/", "/limit/speed/")}


async def test_only_ports_of_the_nodes_own_processes_are_cut(world: RobotWorld) -> None:
    world.master.services["/reset"] = "rosrpc://base:22"
    await world.until_settled()
    assert world.cuts[0] == {5001, 5002, 5003}


async def test_connections_that_are_not_cut_are_reported_until_the_next_adoption(world: RobotWorld) -> None:
    world.kept = {"TCP 5001": "process 7: /opt/own/robot"}
    assert (await world.operation.take()).not_cut == world.kept
    await world.until_settled()
    assert world.operation.left.connections == world.kept
    world.kept = {}
    assert (await world.operation.take()).not_cut == {}


async def test_no_port_of_the_machine_itself_is_cut_whatever_a_node_says(bare: RobotWorld) -> None:
    bare.resolved["nuc"] = ["192.168.50.2"]
    bare.add("/far", 4010, uri="http://nuc:4010/", publishes=("/scan",), services=("/a", "/b", "/c"))
    bare.master.services |= {"/a": "rosrpc://nuc:22", "/b": "rosrpc://nuc:11311", "/c": "rosrpc://nuc:5001"}
    bare.apart = {"/a": 22, "/b": 11311, "/c": 5001}
    await bare.until_settled()
    assert bare.remote == [("192.168.50.2", 5001), ("192.168.50.2", 5010)]


async def test_a_robot_without_a_master_gets_one_with_its_whole_graph(world: RobotWorld) -> None:
    await world.until_settled()
    world.holder = None  # robot_upstart's master ended with its launch
    await world.release()
    require_given(world)


@pytest.mark.parametrize("ordered", ["release", "stop"])
async def test_a_foreign_master_gets_nothing_and_the_nodes_keep_their_topics(
    world: RobotWorld, ordered: str
) -> None:
    await world.until_settled()
    world.holder = RobotMaster(9, "/tmp/master", "mallory", "")
    world.master.entries.clear()
    world.master.nodes.clear()
    if ordered == "release":
        world.record = msgspec.structs.replace(world.record, wanted=False)
    held = len(world.adopted())
    report = await world.operation.give()
    assert report.withheld == held > 0
    assert "user mallory) is not the recorded master" in report.withheld_from
    assert (world.master.entries, world.master.nodes) == (set(), {})
    assert (world.record.phase, world.forwarded, world.graph.nodes()) == (Phase.FREE, False, [])
    for node in world.robot.values():
        for topic in node.subscribes:
            expected = [one.uri for one in world.robot.values() if topic in one.publishes]
            assert sorted(node.lists[topic]) == sorted(expected)


async def test_a_master_that_a_release_has_started_is_known_at_the_next_start(world: RobotWorld) -> None:
    await world.until_settled()
    world.holder = None
    await world.operation.give()  # an ordered stop: the adoption stays wanted
    require_given(world)
    world.began.clear()
    await world.until_settled()
    require_taken(world)


async def _restart_under_the_rules(world: RobotWorld) -> None:
    node = world.robot["/teleop"]
    node.uri, node.port, node.links = "http://base:4022/", 4022, {}
    for topic in node.publishes:
        await world.parts.ask("registerPublisher", node.name, topic, "std_msgs/String", node.uri, host=LINK)
    for topic in node.subscribes:
        await world.parts.ask("registerSubscriber", node.name, topic, "std_msgs/String", node.uri, host=LINK)


@pytest.mark.parametrize("dead", [False, True], ids=["", "dead appliance"])
async def test_a_node_that_was_restarted_under_the_rules_is_given_back_with_its_new_uri(
    world: RobotWorld, dead: bool
) -> None:
    await world.until_settled()
    await _restart_under_the_rules(world)
    if dead:
        world.begin()
        world.operation.forwards = False
    await world.release()
    require_given(world)


async def test_a_host_that_does_not_answer_delays_no_node_of_another_one(world: RobotWorld) -> None:
    world.resolved["laptop"] = ["192.168.50.9"]
    for number in range(40):
        world.add(
            f"/a{number}", 5000 + number, f"http://laptop:{5000 + number}/", subscribes=("/odom", "/late")
        )
    await world.until_settled()
    world.silent_host = "192.168.50.9"
    began = clock.now()
    report = await world.operation.release()
    assert clock.now() - began < 9  # an ordered end of the appliance waits 10 s
    assert sorted(report.failed) == sorted(f"/a{number}" for number in range(40))
    assert world.robot["/teleop"].lists["/odom"] == ["http://base:4001/"]
    assert world.record.phase is Phase.FREE


def _start_nodes_at_their_own_master(world: RobotWorld) -> None:
    """Start a new node, and restart one of the robot's, at the robot's own master."""
    world.add("/late", 4009, publishes=("/late", "/cmd_vel"), subscribes=("/odom",))
    node = world.robot["/teleop"]
    node.uri, node.port, node.links = "http://base:4022/", 4022, {}
    world.register(node)
    world.master.tree["late"] = 1
    world.tell_as_own_master()


def _require_nodes_of_their_own_master(world: RobotWorld) -> None:
    require_given(world)
    assert world.master.nodes["/teleop"] == "http://base:4022/"
    assert world.master.nodes["/late"] == "http://base:4009/"
    assert world.master.tree["late"] == 1


@pytest.mark.parametrize("killed", ["", "withdraw", "give again", "tell", "given"])
async def test_a_node_that_starts_at_the_own_master_after_the_forwarding_stays(
    world: RobotWorld, killed: str
) -> None:
    await world.until_settled()
    world.record = msgspec.structs.replace(world.record, wanted=False)
    world.killed_after = killed
    world.after[killed or "withdraw"] = lambda: _start_nodes_at_their_own_master(world)
    await world.until_settled()
    _require_nodes_of_their_own_master(world)


async def test_a_node_that_starts_while_a_dead_appliance_is_released_stays(world: RobotWorld) -> None:
    await world.until_settled()
    world.begin()
    world.operation.forwards = False
    world.record = msgspec.structs.replace(world.record, wanted=False)
    world.after["stand in"] = lambda: _start_nodes_at_their_own_master(world)
    await world.until_settled()
    _require_nodes_of_their_own_master(world)


async def test_nothing_waits_for_a_master_that_is_not_there(world: RobotWorld) -> None:
    world.holder = None
    await world.until_settled()
    assert world.forwarded
    assert world.record.phase is Phase.TAKEN
    assert world.began == []


async def test_a_name_held_by_the_appliance_is_never_taken(world: RobotWorld) -> None:
    await world.until_settled()
    assert all(not node.own for node in world.graph.nodes())
    assert not list(world.parts.registry.registrants(Kind.PUBLICATION, "/rosout_agg"))


async def taken_again(world: RobotWorld) -> None:
    """Do as control does after the firewall's rules came back."""
    await world.operation.settle(await world.operation.facts(), settled=False)


async def test_the_own_master_of_a_taken_graph_knows_no_adopted_subscriber(world: RobotWorld) -> None:
    world.add("/gone", 4004, publishes=("/gone",), subscribes=("/odom",), alive=False)
    await world.until_settled()
    left = {entry for entry in world.master.entries if entry[0] == "subscription"}
    assert left == {("subscription", "/odom", "/gone")}, "that of a node that was not taken over"
    assert {*world.truth()} - world.master.entries == {
        entry for entry in world.truth() if entry[0] == "subscription"
    }


@pytest.mark.parametrize("stored", [False, True])
async def test_a_subscriber_stays_with_the_own_master_until_it_is_on_the_disk(
    world: RobotWorld, stored: bool
) -> None:
    answers = [stored, True]

    async def is_stored() -> bool:
        return answers.pop(0)

    world.operation.stored = is_stored
    await world.until_settled()
    assert (world.truth() <= world.master.entries) is not stored
    await world.operation.settle(await world.operation.facts(), settled=True)
    assert not world.truth() <= world.master.entries


@pytest.mark.parametrize("wanted", [True, False], ids=["taking", "giving"])
@pytest.mark.parametrize("calls", range(1, 8))
async def test_a_kill_between_two_calls_to_the_own_master_loses_nothing(
    world: RobotWorld, calls: int, wanted: bool
) -> None:
    """Control dies while it unregisters subscribers there, or registers them again."""
    if not wanted:
        await world.until_settled()
    world.record = msgspec.structs.replace(world.record, wanted=wanted)
    world.master.calls_until_kill = calls
    await world.until_settled()
    if wanted:
        require_taken(world)
        await world.release()
    require_given(world)


async def test_nothing_of_an_unknown_host_stays_at_the_own_master(world: RobotWorld) -> None:
    """Neither a new name, nor a name of the robot with another URI, nor a changed parameter."""
    await world.until_settled()
    there, driver = world.master, world.robot["/teleop"]
    for name, uri in (("/evil", "http://10.0.0.66:1/"), ("/teleop", "http://10.0.0.66:2/")):
        there.carry_out("registerPublisher", name, ("/cmd_vel", "geometry_msgs/Twist", uri))
    there.carry_out("registerService", "/evil", ("/reset", "rosrpc://10.0.0.66:3", "http://10.0.0.66:1/"))
    there.tree["speed"] = 99.0
    await taken_again(world)
    require_taken(world)
    assert there.tree["speed"] == 1.5
    assert not [uri for name, uri in there.nodes.items() if "10.0.0.66" in uri and name in str(there.entries)]
    (record,) = [one for one in world.parts.records.records if one.event == "graph restored"]
    assert "publication /cmd_vel /evil http://10.0.0.66:1/" in str(record.detail)
    there.shutdowns.clear()
    await world.release()
    require_given(world)
    assert there.nodes["/teleop"] == driver.uri


async def test_a_node_that_starts_while_the_rules_are_removed_is_taken_over(world: RobotWorld) -> None:
    await world.until_settled()
    world.add("/late", 4004, publishes=("/late",), subscribes=("/odom",))
    await taken_again(world)
    require_taken(world)
    await world.release()
    require_given(world)


async def test_a_second_taking_without_unknown_hosts_leaves_no_record(world: RobotWorld) -> None:
    await world.until_settled()
    await taken_again(world)
    assert "graph restored" not in {record.event for record in world.parts.records.records}
