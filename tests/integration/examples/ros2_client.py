"""A node of ROS 2 beside the bridge: hears topics, publishes, calls a service, and prints one JSON object a line."""

import itertools
import json
import sys
import time

import rclpy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from std_msgs.msg import String
from std_srvs.srv import SetBool


def say(**fields: object) -> None:
    sys.stdout.write(json.dumps(fields) + "\n")
    sys.stdout.flush()


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("client")
    odometry: list[int] = []
    node.create_subscription(
        Odometry, "/odom", lambda it: odometry.append(int(it.pose.pose.position.x)), 1000
    )
    node.create_subscription(String, "/rosrv/refusals", lambda it: say(event="refused", words=it.data), 10)
    moves = node.create_publisher(Twist, "/cmd_vel", 10)
    forbidden = node.create_publisher(String, "/forbidden", 10)
    brake = node.create_client(SetBool, "/brake")
    answer = None
    end = time.monotonic() + float(sys.argv[1])
    while time.monotonic() < end:
        until = time.monotonic() + 0.05
        while time.monotonic() < until:
            rclpy.spin_once(node, timeout_sec=0.01)
        move = Twist()
        move.linear.x = 0.5
        moves.publish(move)
        forbidden.publish(String(data="no"))
        if answer is None and brake.service_is_ready():
            answer = brake.call_async(SetBool.Request(data=True))
        if answer is not None and answer.done():
            say(event="answered", success=answer.result().success, message=answer.result().message)
            answer = None
            end = min(end, time.monotonic() + 5)
    gaps = sum(after != before + 1 for before, after in itertools.pairwise(odometry))
    say(event="end", heard=len(odometry), gaps=gaps)


main()
