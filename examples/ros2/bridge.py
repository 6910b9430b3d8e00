"""Carry chosen topics and services between a door of the appliance and ROS 2: bridge.py FILE.

    url: ws://10.0.0.2:9091           # the door's port, or the URL of a ticket
    to_ros2: [{topic: /odom, type: nav_msgs/Odometry}]
    to_ros1: [{topic: /cmd_vel, type: geometry_msgs/Twist}]
    services: [{service: /brake, type: std_srvs/SetBool}]    # offered in ROS 2, called at the door

The appliance decides each of them for the door: its rights, limits, guards and approvals apply, and its log names the
door. Its refusals are logged here and published on /rosrv/refusals. If the door goes away, the bridge ends with
status 1: let its supervisor start it again.
"""

import sys
import threading
from pathlib import Path
from typing import Any

import rclpy
import roslibpy
import yaml
from messages import class_of, to_ros1, to_ros2
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

_SECONDS = 10.0  # the longest wait for the door, and for an answer of a service


class Bridge(Node):
    """A node of ROS 2 with one connection to a door."""

    def __init__(self, settings: dict[str, Any]) -> None:
        super().__init__("rosrv_bridge")
        self._calls = ReentrantCallbackGroup()
        self._refusals = self.create_publisher(String, "/rosrv/refusals", 10)
        self._door = roslibpy.Ros(settings["url"])
        # roslibpy has a place for refusals (`status`), but no public way to listen to them.
        self._door.factory.on_ready(lambda to: to._message_handlers.update(status=self._say_refusal))
        self.ended = threading.Event()
        self._door.on("close", lambda *_: self.ended.set())
        self._door.run(timeout=_SECONDS)
        self._carried = [self._carry_to_ros2(**row) for row in settings.get("to_ros2") or ()]
        self._carried += [self._carry_to_ros1(**row) for row in settings.get("to_ros1") or ()]
        self._offered = [self._offer(**row) for row in settings.get("services") or ()]

    def _carry_to_ros2(self, topic: str, type: str) -> roslibpy.Topic:  # noqa: A002  the word of the file
        kind = class_of(type)
        publisher = self.create_publisher(kind, topic, 100)
        source = roslibpy.Topic(self._door, topic, type)
        source.subscribe(lambda values: publisher.publish(to_ros2(values, kind())))
        return source

    def _carry_to_ros1(self, topic: str, type: str) -> roslibpy.Topic:  # noqa: A002  the word of the file
        target = roslibpy.Topic(self._door, topic, type)
        target.advertise()
        self.create_subscription(
            class_of(type), topic, lambda message: target.publish(roslibpy.Message(to_ros1(message))), 10
        )
        return target

    def _offer(self, service: str, type: str) -> roslibpy.Service:  # noqa: A002  the word of the file
        target = roslibpy.Service(self._door, service, type)

        def answer(request: Any, response: Any) -> Any:
            try:
                values = target.call(roslibpy.ServiceRequest(to_ros1(request)), timeout=_SECONDS)
            except Exception as error:  # noqa: BLE001  roslibpy raises plain exceptions; the caller waits for an answer
                self._say_refusal({"msg": f"{service}: {error}"})
                if hasattr(response, "success"):
                    response.success, response.message = False, str(error)
                return response
            return to_ros2(values, response)

        self.create_service(class_of(type, "srv"), service, answer, callback_group=self._calls)
        return target

    def _say_refusal(self, status: dict[str, Any]) -> None:
        text = str(status.get("msg", status))
        self.get_logger().error(text)
        self._refusals.publish(String(data=text))


def _both_ways(settings: dict[str, Any]) -> list[str]:
    """Return the topics in both directions. Their messages would circle: ROS 2 and a door hear their own."""
    there, back = (
        {row["topic"].strip("/") for row in settings.get(way) or ()} for way in ("to_ros1", "to_ros2")
    )
    return sorted(f"/{topic}" for topic in there & back)


def main() -> int:
    """Run until the door closes the connection."""
    settings = yaml.safe_load(Path(sys.argv[1]).read_text())
    if both := _both_ways(settings):
        sys.exit(f"{', '.join(both)}: carry a topic in one direction only, or its messages circle for ever")
    rclpy.init()
    node = Bridge(settings)
    executor = MultiThreadedExecutor()
    executor.add_node(node)
    while rclpy.ok() and not node.ended.is_set():
        executor.spin_once(timeout_sec=0.2)
    return 1 if node.ended.is_set() else 0


if __name__ == "__main__":
    sys.exit(main())
