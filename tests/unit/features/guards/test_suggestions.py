from pathlib import Path
from typing import Any

import pytest
import yaml

from appliance.features.guards.plans import planned
from appliance.features.guards.presets import PRESETS, GuardError, text_of
from appliance.features.guards.suggestions import Proposal, TopicFacts, proposals
from rosmop.check.sources import compiled_from
from tests.unit.features.guards.guarding import DEFINITIONS

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


def text(proposal: Proposal, graph: list[TopicFacts]) -> str:
    values = {**proposal.measured, **proposal.values}
    return text_of(planned(PRESETS[proposal.preset], proposal.name, proposal.topics, graph, values, {}))


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_robot_is_guarded_without_editing_a_file(robot: str) -> None:
    graph = graph_of(robot)
    found = proposals(graph)
    by_command: dict[str, list[str]] = {}
    for one in found:
        by_command.setdefault(one.topics["command"], []).append(one.preset)
        assert one.command.startswith(f"rosrv guard new {one.preset} {one.topics['command']}")
    assert by_command == ROBOTS[robot]["commands"]
    sources = {f"{one.name}.rv": text(one, graph) for one in found}
    assert len(sources) == len(found)
    assert len(compiled_from(sources, DEFINITIONS).specifications) == len(found)


def test_values_follow_the_present_rates_and_the_frame_of_the_commands() -> None:
    base = {one.preset: one for one in proposals(graph_of("turtlebot3"))}
    assert base["deadman"].command == "rosrv guard new deadman /cmd_vel --shadow silent=0.5"
    assert base["fence"].topics["by"] == "/odom"
    copter = {one.preset: one for one in proposals(graph_of("copter"))}
    assert copter["fence"].values == {"worldFrame": "true"}
    assert copter["arm"].command.endswith("--by /mavros/battery --shadow silent=5")


PLANS = [
    (
        "fence",
        {"command": "/cmd_vel", "by": "/scan"},
        {},
        "/scan has the type sensor_msgs/LaserScan; fence works with",
    ),
    ("speed", {"command": "/cmd_ve"}, {}, "no node has the topic /cmd_ve now; did you mean /cmd_vel?"),
    ("speed", {"command": "/scan"}, {}, "/scan has the type sensor_msgs/LaserScan"),
    (
        "speed",
        {"command": "/cmd_vel"},
        {"command": "geometry_msgs/TwistStamped"},
        "has the type geometry_msgs/Twist on",
    ),
    (
        "agree",
        {"command": "/cmd_vel"},
        {},
        "agree needs a topic for other: give --topic other=TOPIC; this robot has",
    ),
]


@pytest.mark.parametrize(("preset", "topics", "kinds", "why"), PLANS)
def test_a_guard_that_the_graph_contradicts_is_refused(
    preset: str, topics: dict[str, str], kinds: dict[str, str], why: str
) -> None:
    with pytest.raises(GuardError) as error:
        text_of(planned(PRESETS[preset], "guard", topics, graph_of("turtlebot3"), {}, kinds))
    assert why in str(error.value)


def test_a_topic_that_comes_later_has_the_type_that_is_given() -> None:
    later = planned(
        PRESETS["speed"], "later", {"command": "/new"}, [], {}, {"command": "ackermann_msgs/AckermannDrive"}
    )
    assert "event drive(double x) command ackermann_msgs/AckermannDrive" in text_of(later)
    goal = "/arm_controller/follow_joint_trajectory/goal"
    answer = planned(PRESETS["answer"], "answer", {"command": goal}, graph_of("fetch"), {}, {})
    assert answer.topics["cancel"] == goal.replace("/goal", "/cancel")
