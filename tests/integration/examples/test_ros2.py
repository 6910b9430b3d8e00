"""The bridge of examples/ros2 at the door of a running appliance, with rclpy as the wheels have it."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import ROOT, RosSession
from tests.support.waiting import eventually

pytestmark = pytest.mark.nightly
HERE, EXAMPLE = Path(__file__).parent, ROOT / "examples/ros2"
POLICY = """
[Groups]
site = 10.77.0.0/24
migration = door:ros2
[Nodes]
default = site migration
[Publishers]
default = site
/cmd_vel = site migration
[Subscribers]
default = site migration
[Services]
default = site
[Clients]
default = site migration
[Commands]
default = site migration
"""
SETTINGS = """
url: ws://10.77.0.2:9091
to_ros2: [{topic: /odom, type: nav_msgs/Odometry}]
to_ros1: [{topic: /cmd_vel, type: geometry_msgs/Twist}, {topic: /forbidden, type: std_msgs/String}]
services: [{service: /brake, type: std_srvs/SetBool}]
"""
MOVES = """
import json, rospy, geometry_msgs.msg
rospy.init_node("base")
say = lambda it: print(json.dumps({"event": "received", "x": it.linear.x}), flush=True)
rospy.Subscriber("/cmd_vel", geometry_msgs.msg.Twist, say)
rospy.spin()
"""
ODOMETRY = """
import rospy, nav_msgs.msg
rospy.init_node("odometry")
out, rate, number = rospy.Publisher("/odom", nav_msgs.msg.Odometry, queue_size=100), rospy.Rate(100), 0
while not rospy.is_shutdown():
    message = nav_msgs.msg.Odometry()
    message.pose.pose.position.x = number
    out.publish(message)
    number += 1
    rate.sleep()
"""


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a Python with the wheels of the lock file."""
    folder = tmp_path_factory.mktemp("ros2")
    uv = [str(Path(sys.executable).with_name("uv"))]
    subprocess.run([*uv, "venv", "-q", "--python", "/usr/bin/python3", folder / "venv"], check=True)
    made = str(folder / "venv/bin/python")
    lock = str(EXAMPLE / "requirements.lock")
    subprocess.run(
        [*uv, "pip", "install", "-q", "--python", made, "--require-hashes", "-r", lock], check=True
    )
    return made


@pytest.fixture
def appliance(common_lab: Lab) -> Iterator[Appliance]:
    with Appliance(common_lab.host("appliance", "10.77.0.2/24"), policy=POLICY) as running:
        running.rosrv("door", "add", "ros2", "--port", "9091", "--from", "10.77.0.10")
        eventually(lambda: not running.row("door", "list")["trouble"], "the door serves")
        yield running


def test_twenty_five_types_are_equal_after_the_way_there_and_back(python: str) -> None:
    result = subprocess.run(
        [python, HERE / "ros2_messages.py", EXAMPLE], capture_output=True, text=True, check=True
    )
    lines = result.stdout.splitlines()
    assert len(lines) == 25
    assert [line for line in lines if not line.endswith(" equal")] == []


def test_a_door_carries_topics_and_a_service_to_ros_2(
    appliance: Appliance, common_robot: Host, python: str, tmp_path: Path
) -> None:
    """Odometry arrives without loss, a motion and a call get through, and a refusal is seen on both sides."""
    settings = tmp_path / "bridge.yaml"
    settings.write_text(SETTINGS)
    local = ["/usr/bin/env", "ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST", "ROS_DOMAIN_ID=77", python]
    with RosSession(appliance.master_uri, tmp_path, common_robot) as ros:
        ros.service_server("roscpp", "/brake")
        moves = ros.start(["/usr/bin/python3", "-c", MOVES], label="base")
        ros.start(["/usr/bin/python3", "-c", ODOMETRY], label="odometry")
        ros.start([*local, str(EXAMPLE / "bridge.py"), str(settings)], label="bridge")
        client = ros.start([*local, str(HERE / "ros2_client.py"), "60"], label="client")
        assert moves.wait_for(event="received")["x"] == 0.5
        assert client.wait_for(event="answered")["success"] is False
        words = str(client.wait_for(event="refused")["words"])
        assert "/forbidden" in words and "policy.ini" in words
        end = client.wait_for(event="end")
        assert int(str(end["heard"])) > 300 and end["gaps"] == 0
    denied = appliance.rosrv("audit", "search", "--deny", "--topic", "/forbidden", "--json").stdout
    assert "198.19.240." in denied
