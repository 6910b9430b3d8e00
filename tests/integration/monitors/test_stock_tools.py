import json
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import PYTHON, RosSession, need_ros
from tests.support.requirements import need_root
from tests.support.rosmaster import await_node, call_on

SPECIFICATION = """
gate() {
    std_msgs::String report;
    event said(std::string text) /chatter std_msgs/String '{data:text}' {
        report.data = text;
        PUBLISH(/alarm, std_msgs/String, report);
    }
}
"""
GRAPH = """\
import rosgraph.impl.graph, json
graph = rosgraph.impl.graph.Graph()
while not any("/alarm" in edge.label for edge in graph.nn_edges):
    graph.update()
print(json.dumps({"nodes": sorted(graph.nn_nodes), "bad": sorted(graph.bad_nodes)}))
"""
_CALLS = (
    "getPid",
    "getUri",
    "getName",
    "getMasterUri",
    "getPublications",
    "getSubscriptions",
    "getBusInfo",
    "getBusStats",
)


@pytest.fixture(scope="module")
def field() -> Iterator[tuple[Appliance, Host]]:
    need_root()
    need_ros()
    with Lab("rosrv-test") as lab:
        middle, robot = lab.host("appliance", "10.77.0.2/24"), lab.host("robot", "10.77.0.10/24")
        with Appliance(middle, monitors={"gate": SPECIFICATION}, options=("--api", "off")) as appliance:
            for node in ("/rosout", "/rosrv"):
                await_node(appliance.master_uri, robot, node)
            yield appliance, robot


@pytest.fixture
def ros(field: tuple[Appliance, Host], tmp_path: Path) -> Iterator[RosSession]:
    appliance, robot = field
    with RosSession(appliance.master_uri, tmp_path, robot) as session:
        yield session


def test_ping_reaches_every_node(ros: RosSession) -> None:
    ros.talker("rospy", "/chatter", name="voice")
    pinged = ros.run("rosnode", "ping", "-a").stdout
    shown = ros.run("rosnode", "list").stdout.split()
    assert {"/rosout", "/rosrv", "/voice"} <= set(shown)
    assert pinged.count("xmlrpc reply from") == len(shown)
    assert ros.run("rosnode", "cleanup").stdout == ""


def test_info_of_the_monitors_node(ros: RosSession) -> None:
    ros.talker("roscpp", "/chatter", name="voice")
    ros.listener("rospy", "/alarm", name="ear").wait_for(event="received")
    info = ros.run("rosnode", "info", "/rosrv").stdout
    assert "* /alarm [std_msgs/String]" in info
    assert re.search(r"^Pid: \d+$", info, re.MULTILINE)
    assert re.search(r"topic: /alarm\s+\* to: /ear\s+\* direction: outbound", info)


def test_the_graph_has_no_bad_node(ros: RosSession) -> None:
    ros.talker("roscpp", "/chatter", name="voice")
    ros.listener("rospy", "/alarm", name="ear").wait_for(event="received")
    graph = json.loads(ros.run(PYTHON, "-c", GRAPH).stdout)
    assert graph == {"nodes": ["/ear", "/rosout", "/rosrv", "/voice"], "bad": []}


def test_a_tool_cannot_kill_the_monitors_node(ros: RosSession) -> None:
    uri = call_on(ros.host, ros.master_uri, "lookupNode", "/tool", "/rosrv")[2]
    code, why, _ = call_on(ros.host, uri, "shutdown", "/tool", "now")
    assert code == 0
    assert "rosrv monitor" in why
    ros.run("rosnode", "kill", "/rosrv")
    ros.talker("roscpp", "/chatter", name="voice")
    ros.listener("rospy", "/alarm").wait_for(event="received")


@pytest.mark.parametrize("name", ["/rosrv", "/rosout", "/voice", "/cpp_voice"])
def test_every_node_answers_the_calls_of_tools(ros: RosSession, name: str) -> None:
    ros.talker("rospy", "/chatter", name="voice")
    ros.talker("roscpp", "/chatter", name="cpp_voice")
    uri = call_on(ros.host, ros.master_uri, "lookupNode", "/tool", name)[2]
    answers = {call: call_on(ros.host, uri, call, "/tool") for call in _CALLS}
    assert {call: answer[0] for call, answer in answers.items()} == dict.fromkeys(_CALLS, 1)


def test_own_nodes_are_reachable_without_mediation(lab: Lab, robot: Host, tmp_path: Path) -> None:
    middle = lab.host("appliance", "10.77.0.2/24")
    options = ("--relay", "monitored", "--mediation", "monitored", "--api", "off")
    with (
        Appliance(middle, monitors={"gate": SPECIFICATION}, options=options) as appliance,
        RosSession(appliance.master_uri, tmp_path, robot) as ros,
    ):
        for node in ("/rosout", "/rosrv"):
            await_node(appliance.master_uri, robot, node)
        ros.talker("roscpp", "/chatter", name="voice")
        ros.listener("rospy", "/alarm").wait_for(event="received")
        aggregated = ros.start(["rostopic", "echo", "/rosout_agg"])
        ros.start(["rostopic", "pub", "/rosout", "rosgraph_msgs/Log", "msg: heard", "-r", "5"])
        aggregated.wait_for_text("heard")
        assert ros.run("rosnode", "ping", "-a").stdout.count("xmlrpc reply from") >= 4


def test_a_hanging_node_does_not_stop_a_tool(ros: RosSession) -> None:
    voice = ros.talker("rospy", "/chatter", name="voice")
    voice.popen.send_signal(signal.SIGSTOP)
    try:
        done = ros.run("rosnode", "ping", "-a")
        assert "/voice" in done.stderr + done.stdout.replace("Will ping", "").partition("/voice")[2]
        assert done.stdout.count("xmlrpc reply from") == len(ros.run("rosnode", "list").stdout.split()) - 1
        assert "/voice" in ros.run("rosnode", "cleanup", text="y\n").stdout
        assert "/voice" not in ros.run("rosnode", "list").stdout.split()
    finally:
        voice.popen.send_signal(signal.SIGCONT)
