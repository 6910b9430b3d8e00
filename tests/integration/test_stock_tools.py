import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.support.nodes import HERE, PYTHON, Client, RosSession, roscpp_program
from tests.support.processes import Event
from tests.support.site import Site

CLIENTS: list[Client] = ["rospy", "roscpp"]
LAUNCH = """\
<launch>
  <arg name="text" default="from the launch file"/>
  <param name="/launched" value="yes"/>
  <rosparam ns="configured">{limits: {left: 1.5, right: [1, 2]}, names: [a, b]}</rosparam>
  <group ns="pair">
    <node pkg="pair" type="talker" name="voice" args="chatter --text '$(arg text)'" output="screen"/>
    <node pkg="pair" type="listener" name="$(anon ear)" args="heard" output="screen">
      <remap from="heard" to="chatter"/>
    </node>
  </group>
</launch>
"""
PACKAGE = """\
<package format="2">
  <name>pair</name> <version>1.0.0</version> <description>A talker and a listener</description>
  <maintainer email="nobody@example.org">Nobody</maintainer> <license>Apache-2.0</license>
</package>
"""


@pytest.fixture
def ros(site: Site, tmp_path: Path) -> Iterator[RosSession]:
    with RosSession(site.master_uri, tmp_path, site.robot) as session:
        yield session


@pytest.mark.real
def test_rostopic_list(ros: RosSession) -> None:
    ros.talker("rospy", "/chatter")
    ros.listener("roscpp", "/chatter")
    assert "/chatter" in ros.run("rostopic", "list").stdout.split()
    verbose = ros.run("rostopic", "list", "-v").stdout
    assert "* /chatter [std_msgs/String] 1 publisher" in verbose
    assert "* /chatter [std_msgs/String] 1 subscriber" in verbose


@pytest.mark.real
@pytest.mark.parametrize("client", CLIENTS)
def test_rostopic_echo(ros: RosSession, client: Client) -> None:
    ros.talker(client, "/chatter")
    printed = ros.run("rostopic", "echo", "-n", "2", "/chatter").stdout
    assert len(re.findall(r'^data: "hello \d+"$', printed, re.MULTILINE)) == 2


def test_rostopic_echo_does_not_stay_in_the_graph(ros: RosSession) -> None:
    ros.talker("rospy", "/chatter", name="voice")
    ros.run("rostopic", "echo", "-n", "1", "/chatter")
    assert "Subscribers: None" in ros.run("rostopic", "info", "/chatter").stdout


def test_rostopic_hz(ros: RosSession) -> None:
    ros.talker("roscpp", "/chatter")
    hz = ros.start(["rostopic", "hz", "/chatter"])
    hz.wait_for(lambda event: _window(event) >= 20)
    rate = float(hz.wait_for_text("average rate", since=hz.mark()).removeprefix("average rate: "))
    assert 5 < rate < 20


def _window(event: Event) -> int:
    _, found, count = event.get("text", "").rpartition("window: ")
    return int(count) if found else 0


def test_rostopic_pub(ros: RosSession) -> None:
    listeners = [ros.listener("rospy", "/told"), ros.listener("roscpp", "/told")]
    ros.run("rostopic", "pub", "-1", "/told", "std_msgs/String", "data: hi")
    for listener in listeners:
        assert listener.wait_for(event="received")["data"] == "hi"


@pytest.mark.real
def test_rostopic_info_and_type(ros: RosSession) -> None:
    ros.talker("roscpp", "/chatter", name="voice")
    ros.listener("rospy", "/chatter", name="ear")
    info = ros.run("rostopic", "info", "/chatter").stdout
    assert "Type: std_msgs/String" in info
    assert re.search(r"Publishers:\s+\* /voice \(http://", info)
    assert re.search(r"Subscribers:\s+\* /ear \(http://", info)
    assert ros.run("rostopic", "type", "/chatter").stdout.strip() == "std_msgs/String"
    assert "/chatter" in ros.run("rostopic", "find", "std_msgs/String").stdout.split()


def test_rosnode_list(ros: RosSession) -> None:
    ros.talker("rospy", "/chatter", name="voice")
    assert ros.run("rosnode", "list").stdout.split() == ["/rosout", "/voice"]


@pytest.mark.real
@pytest.mark.parametrize("client", CLIENTS)
def test_rosnode_info(ros: RosSession, client: Client) -> None:
    ros.talker(client, "/chatter", name="voice")
    ros.listener("rospy", "/chatter", name="ear").wait_for(event="received")
    info = ros.run("rosnode", "info", "/voice").stdout
    assert "* /chatter [std_msgs/String]" in info
    assert "* /voice/get_loggers" in info
    assert "* /voice/set_logger_level" in info
    assert "Pid:" in info
    assert re.search(r"topic: /chatter\s+\* to: /ear\s+\* direction: outbound", info)


@pytest.mark.parametrize("client", CLIENTS)
def test_rosnode_ping(ros: RosSession, client: Client) -> None:
    ros.talker(client, "/chatter", name="voice")
    assert "xmlrpc reply from" in ros.run("rosnode", "ping", "-c", "1", "/voice").stdout


@pytest.mark.parametrize("client", CLIENTS)
def test_rosnode_kill(ros: RosSession, client: Client) -> None:
    talker = ros.talker(client, "/chatter", name="voice")
    assert "killed" in ros.run("rosnode", "kill", "/voice").stdout
    talker.wait()
    assert "/voice" not in ros.run("rosnode", "list").stdout.split()


@pytest.mark.real
def test_rosparam(ros: RosSession, tmp_path: Path) -> None:
    ros.run("rosparam", "set", "/arm", "{speed: 0.5, joints: [1, 2], name: left}")
    assert yaml.safe_load(ros.run("rosparam", "get", "/arm/speed").stdout) == 0.5
    assert {"/arm/speed", "/arm/joints", "/arm/name"} <= set(ros.run("rosparam", "list").stdout.split())
    dump = tmp_path / "arm.yaml"
    ros.run("rosparam", "dump", str(dump), "/arm")
    assert yaml.safe_load(dump.read_text()) == {"speed": 0.5, "joints": [1, 2], "name": "left"}
    ros.run("rosparam", "delete", "/arm")
    assert ros.run("rosparam", "get", "/arm", check=False).returncode != 0
    ros.run("rosparam", "load", str(dump), "/other")
    assert yaml.safe_load(ros.run("rosparam", "get", "/other/joints").stdout) == [1, 2]
    ros.run("rosparam", "delete", "/other")


@pytest.mark.real
def test_rosservice(ros: RosSession) -> None:
    ros.service_server("roscpp", "/negate", name="negator")
    assert "/negate" in ros.run("rosservice", "list").stdout.split()
    assert ros.run("rosservice", "type", "/negate").stdout.strip() == "std_srvs/SetBool"
    assert ros.run("rosservice", "node", "/negate").stdout.strip() == "/negator"
    assert "Type: std_srvs/SetBool" in ros.run("rosservice", "info", "/negate").stdout
    answer = yaml.safe_load(ros.run("rosservice", "call", "/negate", "true").stdout)
    assert answer == {"success": False, "message": "negated"}


@pytest.mark.real
def test_rosbag(ros: RosSession, tmp_path: Path) -> None:
    bag = tmp_path / "run.bag"
    talker = ros.talker("roscpp", "/chatter")
    ros.run("rosbag", "record", "-l", "5", "-O", str(bag), "/chatter")
    talker.stop()
    assert "5 msgs" in ros.run("rosbag", "info", str(bag)).stdout
    listener = ros.listener("rospy", "/chatter")
    ros.start(["rosbag", "play", "--wait-for-subscribers", "--keep-alive", str(bag)])
    assert len(listener.wait_for_count(5, event="received")) == 5


def package_of_two_nodes(workspace: Path) -> Path:
    package = workspace / "pair"
    package.mkdir(parents=True)
    (package / "package.xml").write_text(PACKAGE)
    talker = package / "talker"
    talker.write_text(f'#!/bin/sh\nexec {PYTHON} {HERE}/rospy_nodes/talker.py "$@"\n')
    talker.chmod(0o755)
    (package / "listener").symlink_to(roscpp_program("listener"))
    launch = package / "pair.launch"
    launch.write_text(LAUNCH)
    return launch


@pytest.mark.real
def test_roslaunch(ros: RosSession, tmp_path: Path) -> None:
    file = package_of_two_nodes(tmp_path / "workspace")
    command = ["roslaunch", "--wait", str(file), "text:=told"]
    launch = ros.start(command, ROS_PACKAGE_PATH=str(tmp_path / "workspace"))
    launch.wait_for(lambda event: event.get("data", "").startswith("told "), publisher="/pair/voice")
    nodes = ros.run("rosnode", "list").stdout.split()
    assert [name.partition("_")[0] for name in nodes] == ["/pair/ear", "/pair/voice", "/rosout"]
    assert yaml.safe_load(ros.run("rosparam", "get", "/launched").stdout) == "yes"
    configured = {"limits": {"left": 1.5, "right": [1, 2]}, "names": ["a", "b"]}
    assert yaml.safe_load(ros.run("rosparam", "get", "/configured").stdout) == configured
    launch.stop(with_signal=signal.SIGINT, timeout=30)
    assert len(launch.seen(event="ended")) == 2
    assert ros.run("rosnode", "list").stdout.split() == ["/rosout"]
    ros.run("rosparam", "delete", "/launched")
    ros.run("rosparam", "delete", "/configured")


def test_tools_run_on_another_host(site: Site, ros: RosSession) -> None:
    ros.talker("roscpp", "/chatter", name="voice")
    elsewhere = ros.on(site.ocu)
    assert "hello" in elsewhere.run("rostopic", "echo", "-n", "1", "/chatter").stdout
    assert "xmlrpc reply from" in elsewhere.run("rosnode", "ping", "-c", "1", "/voice").stdout
