"""A publisher that sends its map to each new subscriber, from its connect callback."""

import signal
import time
from pathlib import Path

import pytest

from tests.support.appliance import Appliance
from tests.support.nodes import RosSession, need_ros

MONITOR = """
begin seen() {
    event seen(std::string text) /map std_msgs/String '{data:text}' { text = "checked " + text; }
}
"""
DISPLAYS = 20


@pytest.mark.parametrize("monitors", [{}, {"seen": MONITOR}], ids=["plain", "monitored"])
def test_each_display_gets_the_map(tmp_path: Path, monitors: dict[str, str]) -> None:
    need_ros()
    with Appliance(monitors=monitors) as appliance, RosSession(appliance.master_uri, tmp_path) as ros:
        greeter = ros.node("rospy", "greeter", "/map", name="greeter")
        bag = tmp_path / "all.bag"
        record = ros.start(["rosbag", "record", "-O", str(bag), "/map"])
        displays = [ros.listener("roscpp", "/map") for _number in range(DISPLAYS)]
        text = "checked map" if monitors else "map"
        heard = [display.wait_for(event="received")["data"] for display in displays]
        assert all(one.startswith(text) for one in heard)
        began = time.monotonic()
        for _number in range(20):  # joins and leaves, faster than a greeting
            ros.listener("roscpp", "/map").kill()
        greetings = len(greeter.seen(event="greeted"))
        assert len(displays[0].seen(event="received")) <= 2, displays[0].story()
        assert greetings <= 4 + DISPLAYS + (time.monotonic() - began)
        record.stop(with_signal=signal.SIGINT, timeout=30)
        assert text in ros.run("rostopic", "echo", "-b", str(bag), "-n", "1", "/map").stdout
