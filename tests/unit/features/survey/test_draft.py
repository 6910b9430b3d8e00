import ipaddress

import pytest

from appliance.features.survey.draft import draft, keys_of
from appliance.policy.cases import run_cases
from appliance.policy.model import Category, Request
from appliance.policy.policy_compiler import compile_policy
from appliance.rpc.graph_inventory import SurveyedNode, SurveyedTopic, problems
from tests.unit.features.survey.surveyed import ARM, BASE, NODES, TABLET, inventory, node

NAMES = {BASE: "base", ARM: "arm.lan", TABLET: "tablet"}
DRAFT = """\
# Drafted from the graph of http://base:11311: review it, and name its groups.
# robot is the machine of the ROS master (10.0.0.1); it may do what it may today.

[Groups]
arm    = 10.0.0.2
tablet = 10.0.0.7

[Nodes]
default = robot
/arm/** = arm
/rviz_* = tablet
/teleop = tablet

[Publishers]
default  = robot
/arm/**  = arm
/cmd_vel = robot tablet

[Subscribers]
default       = robot
/arm/command  = arm
/arm/state    = tablet
/camera/image = tablet
/odom         = robot tablet

[Services]
default = robot
/arm/** = arm
"""


def test_a_draft_reads_as_a_person_would_write_it() -> None:
    text, tests, left_out = draft(inventory(), NAMES)
    assert text.startswith(DRAFT)
    assert left_out == ()
    assert text.count("\n") < 50
    policy = compile_policy(text, file="draft.ini", robot=[ipaddress.ip_address(BASE)])
    assert all(result.passed for result in run_cases(policy, tests, "draft"))


def test_each_right_that_was_seen_has_a_test() -> None:
    tests = draft(inventory(), NAMES).tests
    rights = sum(len(topic.publishers) + len(topic.subscribers) for topic in inventory().topics)
    rights += len(inventory().nodes) + sum(len(service.providers) for service in inventory().services)
    allowed = tests.partition("192.0.2.99")[0].count("\n      - ")
    assert allowed == rights
    assert '  - host: "192.0.2.99"\n    node: /visitor\n    deny:' in tests


def test_only_the_most_specific_key_decides_so_an_exception_is_written() -> None:
    robot, arm = frozenset({"robot"}), frozenset({"arm"})
    keys = keys_of(
        {"/a": robot, "/b": robot, "/c": robot, "/x/1": arm, "/x/2": arm, "/x/y/3": robot, "/x": arm}
    )
    assert keys == {"default": robot, "/x/**": arm, "/x/y/3": robot}


def test_the_rest_of_the_graph_belongs_to_no_other_host_than_the_robot() -> None:
    """Most topics are the arm's, and a new topic is still not its."""
    arm = frozenset({"arm"})
    assert keys_of({"/a": arm, "/b": arm, "/c": frozenset({"robot"})})["default"] == frozenset({"robot"})


@pytest.mark.parametrize("name", ["robot", "default", "ask", "-x", "", "a b", "tablet"])
def test_a_name_that_is_not_that_of_a_group_is_replaced(name: str) -> None:
    text = draft(inventory(), {ARM: name, TABLET: "tablet"}).text
    assert f"{ARM}\n" in text
    assert "host-1 " in text or name == "tablet"


@pytest.mark.parametrize(
    "name", ["/a = robot\n[Options]\naudit-only = all", "/a b", "relative", "/ü", "", "/a\n- deny"]
)
def test_a_name_that_a_node_made_up_writes_no_rule(name: str) -> None:
    topics = (*inventory().topics, SurveyedTopic(name, "std_msgs/String", ("/base",), ("/teleop",)))
    text, tests, left_out = draft(inventory(topics=topics, nodes=(*NODES, node(name, BASE))), NAMES)
    assert left_out == (name,)
    assert "audit-only" not in text + tests


def test_a_robot_that_names_itself_by_the_loopback_is_one_host() -> None:
    nodes = (
        SurveyedNode("/base", "http://localhost:4000/", "127.0.1.1"),
        SurveyedNode("/x", "http://gone:1/", ""),
    )
    text = draft(inventory(master_host="127.0.0.1", nodes=nodes, topics=(), services=()), {}).text
    assert "[Groups]" not in text
    assert "\n[Nodes]\ndefault = robot\n" in text


def test_all_addresses_of_the_machine_of_the_master_are_the_robot() -> None:
    nodes = (node("/base", BASE), node("/odometry", "127.0.1.1"), node("/teleop", TABLET))
    topics = (SurveyedTopic("/tf", "tf2_msgs/TFMessage", ("/base", "/odometry"), ("/teleop",)),)
    found = inventory(
        master_host="127.0.0.1", own=(BASE, "127.0.1.1"), nodes=nodes, topics=topics, services=()
    )
    text, robot = draft(found, NAMES).text, ipaddress.ip_address("10.111.0.1")
    assert BASE not in text
    policy = compile_policy(text, file="draft.ini", robot=[robot])
    assert policy.decide(Request(robot, "/base", Category.PUBLISH, "/tf")).allowed
    assert not list(problems(found))


def test_hosts_without_a_name_get_names_that_no_other_host_has() -> None:
    nodes = (node("/base", BASE), node("/arm", ARM), node("/tablet", TABLET), node("/nuc", "10.0.0.8"))
    found = inventory(nodes=nodes, topics=(), services=())
    text = draft(found, {ARM: "host-2", "10.0.0.8": "host-3"}).text
    assert "host-2 = 10.0.0.2\nhost-3 = 10.0.0.7\nhost-4 = 10.0.0.8\n" in text
