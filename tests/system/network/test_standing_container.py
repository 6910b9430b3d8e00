"""A robot beside an appliance whose policy does not name its own addresses: the appliance shows what is commanded."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.adopted_robot import Robot, rosrv
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.nodes import RosSession, need_ros
from tests.support.processes import Process
from tests.support.waiting import eventually

_POLICY = f"{OPEN_POLICY.replace('*', '10.77.0.10')}\n[Options]\naudit-only = Publishers\n"

pytestmark = pytest.mark.nightly


@pytest.fixture
def box(lab: Lab) -> Host:
    return lab.host("box", "10.77.0.2/24")


@pytest.fixture
def appliance(box: Host) -> Iterator[Appliance]:
    need_ros()
    with Appliance(box, policy=_POLICY) as appliance:
        yield appliance


def test_each_command_is_seen_by_the_appliances_own_looks(
    lab: Lab, box: Host, appliance: Appliance, tmp_path: Path
) -> None:
    robot = lab.host("robot", "10.77.0.10/24")

    def publish(topic: str, speed: float) -> Process:
        value = f"{{linear: {{x: {speed}}}}}"
        return ros.start(
            ["/usr/bin/rostopic", "pub", "-r", "10", topic, "geometry_msgs/Twist", value], label=topic
        )

    def enforced() -> str:
        ordered = ("policy", "enforce", "--when-standing", "--within", "12s")
        return rosrv(Robot(box, ros, {}, {}), appliance, *ordered, check=False)

    with RosSession(f"http://{box.address}:11311", tmp_path, robot) as ros:
        moving = publish("/cmd_vel", 0.5)
        publish("/second/cmd_vel", 0.0)
        for topic in ("/cmd_vel", "/second/cmd_vel"):
            ros.start(["/usr/bin/rostopic", "echo", topic], label=f"base of {topic}")
        eventually(
            lambda: "/second/cmd_vel" in appliance.rosrv("topic", "info", "/second/cmd_vel").stdout, ros.story
        )
        assert "/cmd_vel says that it moves" in enforced()
        moving.stop()
        assert "no zero was commanded on /cmd_vel" in enforced()
        publish("/cmd_vel", 0.0)
        said = enforced()
        assert "the robot stands still: zero for 3 s on /cmd_vel, /second/cmd_vel" in said
        assert "enforces [Publishers]" in said
