from collections.abc import Callable, Sequence

import msgspec
import pytest

from appliance.channel.answers.graph_answers import Graph, Node, Topic
from appliance.features.guards.guard_facts import facts_of
from appliance.features.guards.guard_orders import GuardedDriver, Placement
from appliance.features.guards.robot_graph import RobotGraph
from appliance.features.guards.suggestions import advice
from appliance.features.guards.view import GUARDS_VIEW, BypassedGuard, GuardsState
from tests.support.answers import example
from tests.unit.features.guards.test_suggestions import ROBOTS, graph_of

pytestmark = pytest.mark.anyio
THEIRS = "http://10.0.0.5:41234/"


class Connections:
    def __init__(self) -> None:
        self.answers: list[list[str] | None] = []
        self.asked: list[tuple[str, str]] = []
        self.reported: list[BypassedGuard] = []

    def is_here(self, host: str) -> bool | None:
        return {"10.111.0.1": True, "172.29.77.10": None}.get(host, False)

    async def unknown_publishers(self, node: str, topic: str) -> list[str] | None:
        self.asked.append((node, topic))
        return self.answers.pop(0)


def placed(
    robot: str, host: str, *topics_of_guards: str, commands: Callable[[], Sequence[str]] | None = None
) -> tuple[Placement, Connections]:
    topics = [
        example(
            Topic, name=topic.name, type=topic.type, subscribers=list(topic.subscribers),
            publishers=[{"node": node, "messages_per_second": 1.0} for node in topic.publishers],
        )
        for topic in graph_of(robot)
    ]  # fmt: skip
    names = {node for topic in graph_of(robot) for node in (*topic.publishers, *topic.subscribers)}
    nodes = [example(Node, name=name, host=host if "mux" not in name else "10.0.0.77") for name in names]
    graph = Graph(nodes, topics, [])
    connections = Connections()
    place = Placement(
        commands or (lambda: topics_of_guards), lambda: graph, connections, connections.reported.append
    )
    return place, connections


@pytest.mark.parametrize(
    ("host", "sentences"),
    [
        ("10.111.0.1", []),
        ("10.0.0.5", ["/cmd_vel: the base is on 10.0.0.5: a cut between here and there is not guarded"]),
        ("172.29.77.10", ["/cmd_vel: the base is on 172.29.77.10: if that is another machine than this container's, a"
                          " cut between here and there is not guarded"]),
    ],
)  # fmt: skip
def test_a_base_on_another_machine_is_named_and_a_multiplexer_is_not_a_base(
    host: str, sentences: list[str]
) -> None:
    place, _ = placed("turtlebot3", host, "/cmd_vel")
    assert place.look() == [GuardedDriver("/cmd_vel", "/turtlebot3_core", host)]
    assert place.elsewhere == sentences == place.sentences("/cmd_vel")
    assert not place.sentences("/nothing")


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_node_that_carries_a_command_out_is_asked_and_no_observer(robot: str) -> None:
    commands = [
        name for name, line in ROBOTS[robot]["topics"].items() if "cmd" in name or name.endswith("/goal")
    ]
    place, _ = placed(robot, "10.0.0.5", *commands)
    for driver in place.look():
        assert driver.topic in commands
    placeless, _ = placed(robot, "10.0.0.5")
    assert (placeless.look(), placeless.elsewhere) == ([], [])


def test_each_node_that_carries_a_command_out_is_asked_however_many_there_are() -> None:
    names = [f"/arm_{number}" for number in range(200)]
    topic = example(
        Topic, name="/arm/goal", type="control_msgs/FollowJointTrajectoryActionGoal", subscribers=names
    )
    nodes = [example(Node, name=name, host="10.0.0.5") for name in names]
    graph, connections = Graph(nodes, [topic], []), Connections()
    place = Placement(lambda: ["/arm/goal"], lambda: graph, connections, connections.reported.append)
    assert {driver.node for driver in place.look()} == {*names}


class Name(str):
    """A name that counts how often names are compared."""

    compared = 0

    def __eq__(self, other: object) -> bool:
        Name.compared += 1
        assert Name.compared < 100 * MANY, "the work grows with the square of the topics"
        return str.__eq__(self, other)

    __hash__ = str.__hash__


MANY = 12_500
"""The registrations that one host may have."""


def looked(place: Placement, _graph: Graph) -> None:
    assert place.look() == [GuardedDriver("/cmd_vel", "/turtlebot3_core", "10.0.0.5")]


def warned(place: Placement, _graph: Graph) -> None:
    assert len(place.sentences("/cmd_vel")) == 1


def suggested(_place: Placement, graph: Graph) -> None:
    assert any(" deadman /cmd_vel " in each.command for each in advice(facts_of(graph)).suggestions)


def watched_by_a_test(_place: Placement, graph: Graph) -> None:
    facts = facts_of(graph)
    robots = RobotGraph(facts, ["/cmd_vel"])
    [command] = [topic for topic in facts if topic.name == "/cmd_vel"]
    assert [source.name for source in robots.sources(command, ["nav_msgs/Odometry"])] == ["/odom"]


@pytest.mark.parametrize("both_ends", [False, True])
@pytest.mark.parametrize("use", [looked, warned, suggested, watched_by_a_test])
def test_topics_of_one_host_neither_slow_down_nor_hide_what_is_read_from_the_graph(
    use: Callable[[Placement, Graph], None], both_ends: bool
) -> None:
    place, _ = placed("turtlebot3", "10.0.0.5", "/cmd_vel")
    graph = place._graph()
    graph.nodes.append(example(Node, name="/h", host="10.0.0.66"))
    theirs = example(
        Topic, name="", type="geometry_msgs/Twist", subscribers=["/h"] if both_ends else [],
        publishers=[{"node": "/h", "messages_per_second": 1.0}],
    )  # fmt: skip
    graph.topics[:0] = [
        msgspec.structs.replace(theirs, name=Name(f"/a/{'cmd' if number % 2 else 'x'}{number}"))
        for number in range(MANY // (1 + both_ends))
    ]
    Name.compared = 0
    use(place, graph)


async def test_an_unknown_publisher_is_reported_when_it_is_there_twice_and_until_it_is_gone() -> None:
    place, connections = placed("turtlebot3", "10.0.0.5", "/cmd_vel")
    [driver] = place.look()
    for answer, reported in (
        ([THEIRS], False), ([], False), ([THEIRS], False), (["http://10.0.0.6:1/"], False), ([THEIRS], False),
        ([THEIRS], True), (None, True), ([THEIRS], True), ([], False),
    ):  # fmt: skip
        connections.answers = [answer]
        await place.ask(driver)
        assert place.bypassed == (
            [BypassedGuard("/cmd_vel", "/turtlebot3_core", "10.0.0.5", [THEIRS])] if reported else []
        ), answer
    assert {*connections.asked} == {("/turtlebot3_core", "/cmd_vel")}
    assert connections.reported == [BypassedGuard("/cmd_vel", "/turtlebot3_core", "10.0.0.5", [THEIRS])]


async def test_a_node_without_an_answer_is_named_after_some_questions() -> None:
    place, connections = placed("turtlebot3", "10.0.0.5", "/cmd_vel")
    [driver] = place.look()
    connections.answers = [None, None, None, []]
    for named in (False, False, True, False):
        await place.ask(driver)
        assert place.unanswered == (["/turtlebot3_core"] if named else [])


async def test_a_topic_that_is_not_guarded_any_more_is_forgotten() -> None:
    commands = ["/cmd_vel"]
    place, connections = placed("turtlebot3", "10.0.0.5", commands=lambda: commands)
    [driver] = place.look()
    connections.answers = [[THEIRS], [THEIRS]]
    await place.ask(driver)
    await place.ask(driver)
    assert place.bypassed
    commands.clear()
    assert (place.look(), place.bypassed, place.elsewhere) == ([], [], [])


def test_the_status_has_an_alarm_a_warning_and_a_notice() -> None:
    state = GuardsState(
        1, [], ["/cmd_vel: the base is on 10.0.0.5: a cut between here and there is not guarded"],
        [BypassedGuard("/cmd_vel", "/base", "10.0.0.5", [THEIRS])], ["/base"],
    )  # fmt: skip
    [view] = GUARDS_VIEW.states
    assert [(view.kinds[one.kind.partition(":")[0]].severity, one.kind, one.text) for one in view.alarms(state)] == [
        ("alarm", "guard-bypassed:/cmd_vel",
         f"/base takes /cmd_vel from {THEIRS}, past its guards: end that process, and run rosrv protect --strict on"
         " 10.0.0.5"),
        ("warning", "guard-elsewhere:/cmd_vel",
         "/cmd_vel: the base is on 10.0.0.5: a cut between here and there is not guarded: measure whether the driver"
         " then stops it, with rosrv guard check-driver TOPIC --by TOPIC"),
        ("notice", "guard-unanswered:/base",
         "/base does not answer getBusInfo: whether it takes commands past its guards is unknown"),
    ]  # fmt: skip
