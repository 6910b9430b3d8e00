import runpy
import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests.support.nodes import ROOT

OF_ROS_2 = {
    "messages": ("class_of", "to_ros1", "to_ros2"),
    "rclpy": (),
    "rclpy.callback_groups": ("ReentrantCallbackGroup",),
    "rclpy.executors": ("MultiThreadedExecutor",),
    "rclpy.node": ("Node",),
    "roslibpy": ("Ros", "Topic", "Service", "ServiceRequest", "ServiceResponse"),
    "std_msgs": (),
    "std_msgs.msg": ("String",),
}
"""The modules that a robot with ROS 2 has, and what the bridge imports from them."""


def test_a_topic_is_carried_in_one_direction_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A node of ROS 2 and a door hear their own messages, so each message would circle."""
    for name, members in OF_ROS_2.items():
        module = ModuleType(name)
        vars(module).update(dict.fromkeys(members, object))
        monkeypatch.setitem(sys.modules, name, module)
    settings = tmp_path / "bridge.yaml"
    settings.write_text("to_ros2: [{topic: cmd_vel}, {topic: /odom}]\nto_ros1: [{topic: /cmd_vel}]\n")
    monkeypatch.setattr(sys, "argv", ["bridge.py", str(settings)])
    with pytest.raises(SystemExit, match="/cmd_vel: carry a topic in one direction only"):
        runpy.run_path(str(ROOT / "examples/ros2/bridge.py"), run_name="__main__")
