import json
import re
import signal
from pathlib import Path

import pytest
import yaml

from tests.integration.conformance.nodes import order, rospy_node
from tests.support.nodes import PYTHON, Client, RosSession
from tests.support.site import Site
from tests.support.waiting import eventually

CLIENTS: list[Client] = ["rospy", "roscpp"]
GRAPH = """\
import rosgraph.impl.graph, json
graph = rosgraph.impl.graph.Graph()
while not any("/chatter" in edge.label for edge in graph.nn_edges):
    graph.update()
print(json.dumps({"nodes": sorted(graph.nn_nodes), "bad": sorted(graph.bad_nodes),
                  "edges": sorted({(edge.start, edge.label, edge.end) for edge in graph.nn_edges})}))
"""


def test_rostopic_bw(ros: RosSession) -> None:
    ros.talker("roscpp", "/chatter")
    assert "average:" in ros.start(["rostopic", "bw", "/chatter"]).wait_for_text("average:")


def test_rostopic_delay(ros: RosSession) -> None:
    ros.start(["rostopic", "pub", "-r", "20", "/stamped", "geometry_msgs/PointStamped", "header: auto"])
    line = ros.start(["rostopic", "delay", "/stamped"]).wait_for_text("average delay")
    assert 0 <= float(line.removeprefix("average delay: ")) < 5


def test_rostopic_pub_latched(ros: RosSession) -> None:
    ros.start(["rostopic", "pub", "-l", "/told", "std_msgs/String", "data: kept"])
    for to in CLIENTS * 2:
        assert ros.listener(to, "/told").wait_for(event="received")["data"] == "kept"


def test_rostopic_echo_of_a_bag_and_of_a_field(ros: RosSession, tmp_path: Path) -> None:
    ros.talker("roscpp", "/chatter")
    assert "hello" in ros.run("rostopic", "echo", "-n", "1", "/chatter/data").stdout
    bag = tmp_path / "all.bag"
    record = ros.start(["rosbag", "record", "-a", "-O", str(bag)])
    while "/record_" not in ros.run("rostopic", "info", "/chatter").stdout:
        assert record.running, record.story()
    ros.listener("rospy", "/chatter").wait_for_count(20, event="received")
    record.stop(with_signal=signal.SIGINT, timeout=30)
    assert "hello" in ros.run("rostopic", "echo", "-b", str(bag), "-n", "1", "/chatter").stdout


def test_rosnode_of_a_killed_node(ros: RosSession) -> None:
    voice = ros.talker("rospy", "/chatter", name="voice")
    ros.listener("roscpp", "/chatter", name="ear")
    voice.kill()
    ros.run("rosnode", "ping", "-a", check=False)
    ros.run("rosnode", "info", "/voice", check=False)
    ros.run("rosnode", "cleanup", text="y\n", check=False)  # it fails if the appliance removes the node first
    eventually(
        lambda: set(ros.run("rosnode", "list").stdout.split()) == {"/rosout", "/ear"}, "the node is removed"
    )
    assert "Publishers: None" in ros.run("rostopic", "info", "/chatter").stdout


def test_rosnode_machine_and_list(local: Site, ros: RosSession) -> None:
    ros.talker("rospy", "/chatter", name="voice")
    assert re.search(r"http://127\.0\.0\.1:\d+/ \t?\s*/voice", ros.run("rosnode", "list", "-a").stdout)
    assert "127.0.0.1" in ros.run("rosnode", "machine").stdout
    assert "/voice" in ros.run("rosnode", "machine", "127.0.0.1").stdout


def test_rosnode_kill_all(ros: RosSession) -> None:
    nodes = [
        ros.talker("rospy", "/chatter"),
        ros.listener("roscpp", "/chatter"),
        ros.talker("roscpp", "/chatter"),
    ]
    names = [node.seen(event="ready")[0]["name"] for node in nodes]
    assert "killed" in ros.run("rosnode", "kill", *names).stdout
    for node in nodes:
        node.wait()
    assert ros.run("rosnode", "list").stdout.split() == ["/rosout"]


def test_rosparam_of_a_namespace(ros: RosSession, tmp_path: Path) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text(
        "arm: {joints: [1, 2], 'joint-1.left': {p: 0.5, i: 1e-3}}\nbase: {frame: base_link, enabled: true}\n"
    )
    ros.run("rosparam", "load", str(file), "/robot")
    listed = ros.run("rosparam", "list", "/robot").stdout.split()
    assert "/robot/arm/joint-1.left/p" in listed
    dumped = tmp_path / "dumped.yaml"
    ros.run("rosparam", "dump", str(dumped), "/robot")
    ros.run("rosparam", "delete", "/robot")
    ros.run("rosparam", "load", str(dumped), "/again")
    assert yaml.safe_load(ros.run("rosparam", "get", "/again").stdout) == yaml.safe_load(dumped.read_text())
    ros.run("rosparam", "delete", "/again")


def test_rosservice_find_args_uri(ros: RosSession) -> None:
    ros.service_server("rospy", "/negate", name="server")
    assert "/negate" in ros.run("rosservice", "find", "std_srvs/SetBool").stdout.split()
    assert ros.run("rosservice", "args", "/negate").stdout.strip() == "data"
    assert ros.run("rosservice", "uri", "/negate").stdout.startswith("rosrpc://127.0.0.1:")
    loggers = ros.run("rosservice", "call", "/server/get_loggers").stdout
    assert "rosout" in loggers


def test_graph_as_rqt_graph_reads_it(local: Site, ros: RosSession) -> None:
    ros.talker("rospy", "/chatter", name="voice")
    ros.listener("roscpp", "/chatter", name="ear").wait_for(event="received")
    found = ros.run(PYTHON, "-c", GRAPH).stdout
    graph = json.loads(found)
    assert ["/voice", "/chatter", "/ear"] in graph["edges"]
    assert graph["nodes"] == ["/ear", "/rosout", "/voice"]
    assert graph["bad"] == []


def test_rosgraph(ros: RosSession) -> None:
    ros.talker("roscpp", "/chatter", name="voice")
    ros.start(["rosgraph"]).wait_for_text("/voice :")


def test_rosbag_play_with_a_clock(ros: RosSession, tmp_path: Path) -> None:
    bag = tmp_path / "map.bag"
    source = rospy_node(ros, "orders", "source")
    order(source, "advertise", topic="/map", latch=True)
    order(source, "publish", topic="/map", text="the map")
    ros.run("rosbag", "record", "-l", "1", "-O", str(bag), "/map")
    ear = ros.listener("roscpp", "/other_map")
    clock = ros.start(["rostopic", "echo", "-n", "1", "/clock"])
    ros.start(["rosbag", "play", "--clock", "-k", str(bag), "/map:=/other_map"])
    assert ear.wait_for(event="received")["data"] == "the map"
    clock.wait_for_text("secs")


@pytest.mark.parametrize("local", ["appliance"], indirect=True)  # not reached behind a plain master
@pytest.mark.parametrize(("how", "value"), [("ROS_HOSTNAME", "nowhere.invalid"), ("ROS_IP", "192.0.2.7")])
def test_node_with_an_unreachable_address(local: Site, tmp_path: Path, how: str, value: str) -> None:
    with RosSession(local.master_uri, tmp_path) as ros:
        odd = rospy_node(ros, "orders", "odd", **{"ROS_IP": "", how: value})
        order(odd, "advertise", topic="/odd", latch=True)
        order(odd, "publish", topic="/odd", text="here")
        order(odd, "subscribe", topic="/chatter")
        for to in CLIENTS:
            assert ros.listener(to, "/odd").wait_for(event="received")["data"] == "here"
        ros.talker("roscpp", "/chatter")
        odd.wait_for(event="received", topic="/chatter")
        assert "xmlrpc reply" in ros.run("rosnode", "ping", "-c", "1", "/odd").stdout
