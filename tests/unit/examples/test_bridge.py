import runpy
import sys
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from tests.support.nodes import ROOT

OF_ROS_2 = (
    "messages", "rclpy", "rclpy.callback_groups", "rclpy.executors", "rclpy.node", "roslibpy", "std_msgs",
    "std_msgs.msg",
)  # fmt: skip


def test_a_topic_is_carried_in_one_direction_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A node of ROS 2 and a door hear their own messages, so each message would circle."""
    for name in OF_ROS_2:
        monkeypatch.setitem(sys.modules, name, MagicMock(Node=object))
    settings = tmp_path / "bridge.yaml"
    settings.write_text("to_ros2: [{topic: cmd_vel}, {topic: /odom}]\nto_ros1: [{topic: /cmd_vel}]\n")
    monkeypatch.setattr(sys, "argv", ["bridge.py", str(settings)])
    with pytest.raises(SystemExit, match="/cmd_vel: carry a topic in one direction only"):
        runpy.run_path(str(ROOT / "examples/ros2/bridge.py"), run_name="__main__")
