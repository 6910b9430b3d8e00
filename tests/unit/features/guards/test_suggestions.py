import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

from appliance.features.guards import robot_graph as types
from appliance.features.guards.guard_answers import LoadedSuggestion, Suggestion, Suggestions
from appliance.features.guards.presets import PRESETS, GuardError, text_of, topics_in, types_in, values_in
from appliance.features.guards.robot_graph import MAX_COMMANDS, RobotGraph, TopicFacts
from appliance.features.guards.stimuli import stimulus
from appliance.features.guards.suggestions import NOT_SUGGESTED, advice
from appliance.features.guards.upgrades import plan
from rosmop.check.sources import compiled_from
from tests.support.examples import sample
from tests.support.features.guards.running_guard import DEFINITIONS
from tests.support.rows import require_rows
from tests.unit.features.guards.guarding import NODES, Guarded, legs_of, seeded, twist

ROBOTS: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("robots.yaml").read_text(encoding="utf-8"))


def graph_of(robot: str) -> list[TopicFacts]:
    rows = []
    for name, line in ROBOTS[robot]["topics"].items():
        kind, rate, *ends = line.split()
        publishers, _, subscribers = " ".join(ends).partition(">")
        rows.append(
            TopicFacts(name, kind, tuple(publishers.split()), tuple(subscribers.split()), float(rate))
        )
    return rows


def text(proposal: Suggestion, graph: list[TopicFacts]) -> str:
    values = {**proposal.measured, **proposal.values}
    return text_of(plan(PRESETS[proposal.preset], proposal.name, proposal.topics, graph, values, {}))


def printed(found: Suggestions) -> Iterator[str]:
    for suggestion in found.suggestions:
        yield suggestion.command.removeprefix("rosrv guard new ")
        yield from (f"  instead: {', '.join(topics)}" for topics in suggestion.others.values())
    yield from (f"! {sentence}" for sentence in found.left_out)
    yield from (f"- {sentence}" for sentence in found.not_protected[:-1])


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_robot_is_guarded_without_editing_a_file(robot: str) -> None:
    graph = graph_of(robot)
    found = advice(graph)
    assert [*printed(found)] == ROBOTS[robot]["proposal"].splitlines()
    assert found.not_protected[-1].startswith("never by a guard: ")
    sources = {f"{suggestion.name}.rv": text(suggestion, graph) for suggestion in found.suggestions}
    assert len(sources) == len(found.suggestions)
    if robot not in sample(ROBOTS, 4):
        return
    assert len(compiled_from(sources, DEFINITIONS, lints=False).specifications) == len(found.suggestions)


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_order_of_topics_and_further_observers_change_nothing(robot: str) -> None:
    """A graph has no order, and a plot or a recording is not a base."""
    graph = graph_of(robot)
    found = advice(graph)
    for seed in range(5):
        mixed = [one._replace(subscribers=(*one.subscribers, "/record_1", "/rqt_plot")) for one in graph]
        seeded(seed).shuffle(mixed)
        again = advice(mixed)
        assert {one.command for one in again.suggestions} == {one.command for one in found.suggestions}
        assert {*again.left_out} == {*found.left_out}
        assert [len(one) for one in again.not_protected] == [len(one) for one in found.not_protected]


@pytest.mark.parametrize("robot", ROBOTS)
def test_nothing_is_proposed_that_is_loaded(robot: str) -> None:
    graph = graph_of(robot)
    found = advice(graph).suggestions
    loaded = [LoadedSuggestion(f"mine_{place}", one.preset, one.topics) for place, one in enumerate(found)]
    again = advice(graph, loaded)
    assert (again.suggestions, {guard.name for guard in again.loaded}) == (
        [],
        {guard.name for guard in loaded},
    )
    one_less = advice(graph, loaded[1:], ["deadman", "deadman_2"])
    assert [suggestion.topics for suggestion in one_less.suggestions] == [found[0].topics]
    assert one_less.suggestions[0].name not in {"deadman", "deadman_2"}


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_second_robot_changes_nothing_for_the_first(robot: str) -> None:
    """Each has its nodes and topics below its namespace: no proposal mixes the two."""
    alone, both = (
        advice(moved(graph_of(robot), "a")),
        advice([*moved(graph_of(robot), "b"), *moved(graph_of(robot), "a")]),
    )

    def essence(one: Suggestion) -> tuple[str, dict[str, str]]:
        return one.preset, {name: topic for name, topic in one.topics.items() if name != "reset"}

    assert [essence(suggestion) for suggestion in alone.suggestions] == [
        essence(one) for one in both.suggestions if one.topics["command"].startswith("/a/")
    ]
    for one in both.suggestions:
        assert len({topic.split("/")[1] for topic in one.topics.values()}) == 1


def moved(graph: list[TopicFacts], space: str) -> list[TopicFacts]:
    return [
        one._replace(
            name=f"/{space}{one.name}",
            publishers=tuple(f"/{space}{node}" for node in one.publishers),
            subscribers=tuple(f"/{space}{node}" for node in one.subscribers),
        )
        for one in graph
    ]


@pytest.mark.parametrize("robot", ROBOTS)
def test_without_its_source_a_guard_is_left_out(robot: str) -> None:
    """No neighbour's source takes its place."""
    graph = moved(graph_of(robot), "a")
    for suggestion in advice(graph).suggestions:
        sources = {topic for name, topic in suggestion.topics.items() if name not in {"command", "reset"}}
        less = [topic for topic in graph if topic.name not in sources]
        again = advice([*moved(graph_of(robot), "b"), *less]).suggestions
        assert all(topic.startswith("/a/") for each in again if each.topics["command"].startswith("/a/")
                   for topic in each.topics.values())  # fmt: skip


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_guard_hears_some_command_of_each_driver_or_a_sentence_says_that_it_does_not(robot: str) -> None:
    """No message of a process to itself leaves it, as when both ends of a command are nodelets of one manager."""
    graph = graph_of(robot)
    for command in ["", *dict.fromkeys(one.topics["command"] for one in advice(graph).suggestions)]:
        merged = graph
        if command:
            [topic] = [topic for topic in graph if topic.name == command]
            merged = in_one_process({*topic.publishers, *RobotGraph(graph).ends(topic)}, graph)
        found, read = advice(merged), RobotGraph(merged)
        for topic in read.topics:
            if topic.name in {suggestion.topics["command"] for suggestion in found.suggestions}:
                own = read.ends(topic).intersection(topic.publishers)
                assert {*topic.publishers} - own or not own, topic
                for node in own:
                    assert any(
                        f"{node} also publishes {topic.name} to itself" in one for one in found.left_out
                    )
        sent = [velocity for velocity in read.velocities if "/manager" in velocity.publishers]
        if not any({*one.subscribers} - {"/manager"} for one in sent):
            heard = {
                one.name for one in read.velocities if read.crosses(one) and "/manager" in one.subscribers
            }
            assert heard <= {suggestion.topics["command"] for suggestion in found.suggestions}


def in_one_process(nodes: set[str], graph: list[TopicFacts]) -> list[TopicFacts]:
    def ends(names: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(dict.fromkeys("/manager" if node in nodes else node for node in names))

    return [one._replace(publishers=ends(one.publishers), subscribers=ends(one.subscribers)) for one in graph]


TWIST, STAMPED, ODOMETRY = "geometry_msgs/Twist", "geometry_msgs/TwistStamped", "nav_msgs/Odometry"
BASE = [
    TopicFacts("/cmd_vel", TWIST, ("/nav",), ("/base",), 10),
    TopicFacts("/odom", ODOMETRY, ("/base",), ("/nav",), 10),
]
DIRECTIONS = [
    # a further velocity; the topics that a deadman guards with it; whether a sentence asks about it
    (TopicFacts("/base/ref", TWIST, ("/dock",), ("/base",)), {"/cmd_vel", "/base/ref"}, False),
    (TopicFacts("/base/ref", STAMPED, (), ("/base",)), {"/cmd_vel", "/base/ref"}, False),
    (TopicFacts("/base/out", TWIST, ("/base",), ("/motors",)), {"/cmd_vel"}, False),
    (TopicFacts("/base/cmd_vel_out", STAMPED, ("/base",), ("/logger",)), {"/cmd_vel"}, True),
    (TopicFacts("/base/velocity", TWIST, ("/base",), ("/logger",)), {"/cmd_vel"}, False),
    (TopicFacts("/wheel_twist", TWIST, ("/encoders",), ("/base",)), {"/cmd_vel"}, True),
    (TopicFacts("/target", TWIST, ("/camera",), ("/people_tracker",)), {"/cmd_vel"}, False),
    (TopicFacts("/target", TWIST, ("/camera",), ("/display",)), {"/cmd_vel"}, True),
    (TopicFacts("/target", TWIST, ("/camera",), ("/rviz",)), {"/cmd_vel"}, False),
]


@pytest.mark.parametrize(("velocity", "guarded", "asked"), DIRECTIONS)
def test_a_velocity_is_a_command_by_its_direction(
    velocity: TopicFacts, guarded: set[str], asked: bool
) -> None:
    for graph in ([*BASE, velocity], [velocity, *BASE]):
        found = advice(graph)
        assert {one.topics["command"] for one in found.suggestions if one.preset == "deadman"} == guarded
        assert any("may be a command" in one for one in found.left_out) == asked


def test_a_navigation_that_also_publishes_odometry_commands_the_base() -> None:
    graph = [
        TopicFacts("/cmd_vel", TWIST, ("/nav",), ("/base",)),
        TopicFacts("/odom", ODOMETRY, ("/nav",), ()),
    ]
    assert {"deadman", "fence"} <= {suggestion.preset for suggestion in advice(graph).suggestions}


def test_the_list_of_what_is_not_protected_is_never_empty_and_knows_the_guards_in_use() -> None:
    for graph in ([], [TopicFacts("/chatter", "std_msgs/String", ("/a",), ("/b",))]):
        assert len(advice(graph).not_protected) == 2
    loaded = [
        LoadedSuggestion(preset, preset, {"command": "/cmd_vel", "by": "/x"})
        for preset in ("deadman", "estop", "zone", "fence", "mode", "hold_to_run", "overspeed")
    ]
    assert len(advice(BASE, loaded).not_protected) == 1
    for place, guard in enumerate(loaded[1:], 1):
        assert len(advice(BASE, [*loaded[:place], *loaded[place + 1 :]]).not_protected) == 1 + (
            guard.preset != "fence"
        )


STATES = {"free": True, "stopping": True, "withholding": True, "off": False, "shadow": False, "broken": False,
          "holding": False}  # fmt: skip


@pytest.mark.parametrize("robot", ROBOTS)
def test_only_guards_in_force_close_a_gap_of_the_safety_manual(robot: str) -> None:
    """The better a robot is equipped, the more is proposed for it; a proposal protects as little as an idle guard."""
    graph = graph_of(robot)
    found = advice(graph)
    needed = {*types.COMMANDS, *types.GOALS, ODOMETRY, "sensor_msgs/JointState"}
    without_sources = advice([topic for topic in graph if topic.type in needed])
    assert gaps(found.unguarded) >= gaps(without_sources.not_protected) | gaps(found.not_protected)
    for state, in_force in STATES.items():
        loaded = [LoadedSuggestion(one.name, one.preset, one.topics, state) for one in found.suggestions]
        named = advice(graph, loaded)
        assert gaps(named.unguarded) == gaps(found.not_protected if in_force else found.unguarded), state
        idle = state in ("off", "broken")
        assert gaps(named.not_protected) == gaps(found.unguarded if idle else found.not_protected), state


def gaps(lines: Sequence[str]) -> set[tuple[str, str]]:
    """Return the gaps and commands of these lines, without the advice."""
    assert lines[-1].startswith("never by a guard: ")
    heads = [line.partition(": ")[0] for line in lines[:-1]]
    return {
        (re.sub(r"/[^\s,]+(?:, /[^\s,]+)*", "…", head), name)
        for head in heads
        for name in re.findall(r"/[^\s,]+", head)
    }


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_robot_moves_behind_each_proposal_while_all_its_registered_nodes_send(robot: str) -> None:
    """With the values that a sentence names, forward passes, and backward, however many nodes share a source."""
    commanded = {*types.COMMANDS, *types.GOALS, *types.RESULTS}
    for more in ((), ("/second", "/third")):
        graph = [
            topic._replace(publishers=(*topic.publishers, *more) if topic.publishers else ())
            if topic.type not in commanded
            else topic
            for topic in graph_of(robot)
        ]
        found = advice(graph)
        for suggestion in found.suggestions:
            assert moves(suggestion, graph, named_values(suggestion, found.left_out)), suggestion.command


def named_values(one: Suggestion, sentences: Sequence[str]) -> dict[str, str]:
    """Return the values of a scanner, of several that together see all round."""
    for sentence in sentences:
        scans = sentence.rpartition("(")[2].rstrip(")").split(", ")
        if one.preset == "separation" and "set mounted and sector" in sentence and one.topics["by"] in scans:
            mounted = math.remainder(2 * math.pi * scans.index(one.topics["by"]) / len(scans), 2 * math.pi)
            return {"mounted": f"{mounted}", "sector": "2.3"} | (
                {"unseen": "1"} if "unseen" in sentence else {}
            )
    return {}


def moves(one: Suggestion, graph: list[TopicFacts], named: dict[str, str]) -> bool:
    """Whether a motion passes when each publisher has sent what an honest robot sends, at its rate, for 3 s."""
    preset = PRESETS[one.preset]
    guard = plan(preset, one.name, one.topics, graph, {**one.measured, **one.values, **named}, {})
    sent: dict[str, list[bytes]] = {}
    text = text_of(guard)
    kinds = dict.fromkeys(("stop", "reset", "fix", "check"), "std_msgs/Bool") | types_in(text)
    test = stimulus(one.preset, topics_in(text), kinds, values_in(text))
    for message in test.messages[: test.fault]:
        sent.setdefault(message.topic, []).append(message.data)
    facts = {topic.name: topic for topic in graph}
    nodes: list[str] = []
    due = []
    for given, name in guard.topics.items():
        if name not in sent or (given != "command" and name not in facts):
            continue
        publishers = facts[name].publishers or ("/operator",)
        for place, node in enumerate(publishers):
            nodes += [node] if node not in nodes else []
            period = 1000 * len(publishers) / (facts[name].rate or _UNKNOWN_HZ)
            due += [
                (round(number * period + place), given, node, number)
                for number in range(int(6000 / period) + 1)
            ]
    robot = Guarded(one.preset, dict(guard.types), **{
        name: valued(preset.parameter(name).kind, value) for name, value in guard.values.items()
    })  # fmt: skip
    passed = set[bytes]()
    motions = [sent[one.topics["command"]][-1]]
    if guard.types["command"] == TWIST:
        motions.append(twist(-legs_of(motions[0])[0], 0, 0, 0, 0, 0))
    for at, given, node, number in sorted(due):
        said = sent[guard.topics[given]]
        data = said[number % len(said)]
        if given == "command":
            data = said[0] if at < 3000 else motions[0 if at < 4500 else -1]
        outcome = robot.tell(given, data, at, NODES[1 + nodes.index(node)])
        if given == "command" and at >= 3000 and outcome.result not in {"dropped", "changed"}:
            passed.add(data)
    return passed >= {*motions}


_UNKNOWN_HZ = 10.0


def valued(kind: str, value: str) -> Any:
    if kind == "bool":
        return value == "true"
    return int(value) if kind == "int" else float(value) if kind == "double" else value


BUTTONS = [  # the rates of its publishers; the values of the estop; whether a sentence names the rate
    ((10.0,), "silent=0.5 publishers=1", False),
    ((10.0, 10.0), "silent=0.5 publishers=2", False),
    ((1.0,), "silent=2.5 publishers=1", True),
    ((20.0, 1.0), "silent=2.5 publishers=2", True),
    ((20.0, 0.0), "publishers=2", True),
    ((0.0,), "publishers=1", True),
    ((0.02,), "silent=60 publishers=1", True),
]


@pytest.mark.parametrize(("rates", "values", "said"), BUTTONS)
def test_a_button_is_as_many_publishers_as_there_are_at_the_slowest_rate(
    rates: tuple[float, ...], values: str, said: bool
) -> None:
    nodes = tuple(f"/button_{place}" for place in range(len(rates)))
    found = advice([*BASE, TopicFacts("/e_stop", "std_msgs/Bool", nodes, ("/base",), sum(rates), (), rates)])
    assert [one.command.partition("--shadow ")[2] for one in found.suggestions if one.preset == "estop"] == [
        values
    ]
    assert any("failure" in one for one in found.left_out) == said
    command = TopicFacts("/cmd_vel", TWIST, nodes, ("/base",), sum(rates), (), rates)
    slowest = min((rate for rate in rates if rate), default=0)
    silent = f"silent={min(max(5 / slowest, 0.2), 2):.3g}" if slowest else "--shadow"
    assert any(
        one.command.endswith(f" {silent}") for one in advice([command]).suggestions if one.preset == "deadman"
    )


STOPS = {
    "/e_stop": True, "/estop": True, "/emergency_stop": True, "/robot1/estop_pressed": True, "/hw_estop": True,
    "/protective_stop": True, "/is_runstopped": True, "/software_runstop_enabled": True, "/front/e_stop_button": True,
    "/runstop": True, "/emergency_stop_reset": False, "/estop_released": False, "/estop_enabled": False,
    "/estop_ok": False, "/estop_not_pressed": False, "/estop_clear": False, "/estop_disabled": False,
    "/runstop_motion_enabled": False, "/estop_heartbeat": False, "/safe/scan": False, "/stop_sign": False,
}  # fmt: skip


@pytest.mark.parametrize(("topic", "stops"), STOPS.items())
def test_a_stop_is_proposed_only_if_its_name_says_what_true_means(topic: str, stops: bool) -> None:
    graph = [
        TopicFacts("/cmd_vel", "geometry_msgs/Twist", ("/teleop",), ("/base",)),
        TopicFacts(topic, "std_msgs/Bool", ("/plc",), (), 10),
    ]
    found = {one.topics["stop"] for one in advice(graph).suggestions if one.preset == "estop"}
    assert found == ({topic} if stops else set())


RESETS = {
    "/emergency_stop_reset": True, "/estop/reset": True, "/clear_estop": True, "/safety/resetEstop": True,
    "/estopReset": True, "/clearpath/e_stop": False, "/preset/emergency_stop": False, "/nuclear/estop_button": False,
    "/clearpath/estop_released": False, "/reset/estop": False,
}  # fmt: skip


@pytest.mark.parametrize(("topic", "resets"), RESETS.items())
def test_a_reset_is_a_word_of_its_name_and_never_the_stop_itself(topic: str, resets: bool) -> None:
    """A stop that is its own reset could never be reset."""
    graph = [
        TopicFacts("/cmd_vel", "geometry_msgs/Twist", ("/teleop",), ("/base",)),
        TopicFacts("/e_stop", "std_msgs/Bool", ("/plc",), (), 10),
        TopicFacts(topic, "std_msgs/Bool", ("/plc",), (), 10),
    ]
    found = [suggestion.topics for suggestion in advice(graph).suggestions if suggestion.preset == "estop"]
    assert found and all(("reset" in one) == resets and one["stop"] != one.get("reset") for one in found)


def scanned(command: str, kind: str, scan: str) -> Suggestions:
    return advice([
        TopicFacts(command, kind, ("/teleop",), ("/base",), 10),
        TopicFacts(scan, "sensor_msgs/LaserScan", ("/lidar",), ("/base",), 10),
    ])  # fmt: skip


@pytest.mark.parametrize(
    ("scan", "said"),
    [
        ("/scan", False),
        ("/front/scan", False),
        ("/scan_rear", True),
        ("/lidar_left/scan", True),
        ("/b_scan", True),
    ],
)
def test_a_scanner_that_may_not_look_ahead_needs_its_direction(scan: str, said: bool) -> None:
    found = scanned("/cmd_vel", "geometry_msgs/Twist", scan)
    assert "separation" in {suggestion.preset for suggestion in found.suggestions}
    assert any("set mounted and sector" in one for one in found.left_out) == said


@pytest.mark.parametrize("leaf", ["cmd_vel", "cmd_vel_unstamped"])
def test_no_separation_is_proposed_for_velocities_in_the_frame_of_the_map(leaf: str) -> None:
    kind = "geometry_msgs/TwistStamped" if leaf == "cmd_vel" else "geometry_msgs/Twist"
    found = scanned(f"/mavros/setpoint_velocity/{leaf}", kind, "/scan")
    presets = {suggestion.preset for suggestion in found.suggestions}
    assert "sensor" in presets and "separation" not in presets
    assert any("separation of /mavros" in one for one in found.left_out)


def test_a_flood_of_topics_is_cut_and_said() -> None:
    graph = [
        TopicFacts(f"/r{number}/cmd_vel", "geometry_msgs/Twist", ("/operator",), (f"/r{number}",), 10)
        for number in range(700)
    ]
    found = advice(graph)
    assert len({suggestion.topics["command"] for suggestion in found.suggestions}) == MAX_COMMANDS
    assert "only the first" in found.left_out[-1]


@pytest.mark.complete
def test_each_preset_is_proposed_for_some_robot_or_has_a_reason() -> None:
    found = {suggestion.preset for robot in ROBOTS for suggestion in advice(graph_of(robot)).suggestions}
    where = (
        "suggestions.py: propose it for a robot of robots.yaml, or list it in NOT_SUGGESTED with the reason"
    )
    require_rows(PRESETS, found | NOT_SUGGESTED.keys(), where)
    assert not found & NOT_SUGGESTED.keys()


def test_a_topic_of_any_type_is_watched_by_its_silence_alone() -> None:
    types = {"by": "sensor_msgs/Joy"}
    for kind, silent in (("sensor_msgs/Joy", True), ("std_msgs/String", True), ("sensor_msgs/Imu", False)):
        graph = [*graph_of("turtlebot3"), TopicFacts("/link", kind, ("/joy",), ())]
        guard = plan(
            PRESETS["sensor"], "link", {"command": "/cmd_vel", "by": "/link"}, graph, {"silent": "0.3"}, {}
        )
        assert (guard.values.get("frozen") == "0") == silent
        compiled_from({"link.rv": text_of(guard)}, DEFINITIONS)
    with pytest.raises(GuardError, match="only the silence is judged"):
        plan(PRESETS["sensor"], "link", {"command": "/cmd_vel", "by": "/joy"}, graph, {"frozen": "5"}, types)


PLANS = [
    ("fence", {"command": "/cmd_vel", "by": "/scan"}, {},
     "/scan has the type sensor_msgs/LaserScan; fence works with"),
    ("speed", {"command": "/cmd_ve"}, {}, "no node has the topic /cmd_ve now; did you mean /cmd_vel?"),
    ("speed", {"command": "/scan"}, {}, "/scan has the type sensor_msgs/LaserScan"),
    ("speed", {"command": "/cmd_vel"}, {"command": "geometry_msgs/TwistStamped"},
     "has the type geometry_msgs/Twist on"),
    ("agree", {"command": "/cmd_vel", "by": "/odom", "other": "/odom"}, {},
     "agree needs two topics for by and other, and /odom is given for both"),
    ("agree", {"command": "/cmd_vel"}, {}, "agree needs a topic for other: give --topic other=TOPIC; this robot has"),
]  # fmt: skip


@pytest.mark.parametrize(("preset", "topics", "kinds", "why"), PLANS)
def test_a_guard_that_the_graph_contradicts_is_refused(
    preset: str, topics: dict[str, str], kinds: dict[str, str], why: str
) -> None:
    with pytest.raises(GuardError) as error:
        text_of(plan(PRESETS[preset], "guard", topics, graph_of("turtlebot3"), {}, kinds))
    assert why in str(error.value)


def test_a_topic_that_comes_later_has_the_type_that_is_given() -> None:
    later = plan(
        PRESETS["speed"], "later", {"command": "/new"}, [], {}, {"command": "ackermann_msgs/AckermannDrive"}
    )
    assert "command = /new ackermann_msgs/AckermannDrive;" in text_of(later)
    goal = "/arm_controller/follow_joint_trajectory/goal"
    answer = plan(PRESETS["answer"], "answer", {"command": goal}, graph_of("fetch"), {}, {})
    assert answer.topics["cancel"] == goal.replace("/goal", "/cancel")


def test_topics_of_another_host_crowd_out_none_of_the_robot() -> None:
    own = TopicFacts("/cmd_vel", TWIST, ("/nav",), ("/base",), 10.0, ("10.0.0.66", "127.0.0.1"))
    graph = [own] + [
        TopicFacts(f"/a{number}/cmd_vel", TWIST, ("/a",), ("/b",), 10.0, ("10.0.0.66",))
        for number in range(600)
    ]
    assert "/cmd_vel" in {suggestion.command for suggestion in advice(graph).suggestions} | {
        topic for suggestion in advice(graph).suggestions for topic in suggestion.topics.values()
    }


@pytest.mark.parametrize(
    ("more", "by"),
    [
        ({}, "/diagnostics"),
        (
            {"/diagnostics_agg": "/diagnostics"},
            "/diagnostics_agg",
        ),  # an aggregator keeps silent entries, as STALE
        ({"/own/diagnostics": "/odom"}, ""),
    ],
)
def test_diagnostics_stop_the_base_with_all_entries_until_a_person_names_those_that_count(
    more: dict[str, str], by: str
) -> None:
    array = "diagnostic_msgs/DiagnosticArray"
    heard = {name: tuple(f"/of{name}" for name, other in more.items() if other == of) for name, of in
             {"/diagnostics": "/diagnostics", "/odom": "/odom"}.items()}  # fmt: skip
    graph = [
        TopicFacts("/cmd_vel", "geometry_msgs/Twist", ("/teleop",), ("/base",), 10.0),
        TopicFacts("/odom", "nav_msgs/Odometry", ("/base",), heard["/odom"], 50.0),
        TopicFacts("/diagnostics", array, ("/base", "/laser"), heard["/diagnostics"], 2.0),
        *(TopicFacts(name, array, (f"/of{name}",), (), 1.0) for name in more),
    ]
    found = advice(graph)
    assert [one.topics["by"] for one in found.suggestions if one.preset == "diagnostics"] == [by] * bool(by)
    [said] = [sentence for sentence in found.left_out if sentence.startswith("diagnostics of /cmd_vel")]
    assert ("is not known" in said) == bool(by)
    for topic in graph:
        if topic.type == array:
            unheard = [one if one is not topic else one._replace(publishers=()) for one in graph]
            names = {
                one.topics.get("by") for one in advice(unheard).suggestions if one.preset == "diagnostics"
            }
            assert topic.name not in names
