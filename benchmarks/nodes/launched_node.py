#!/usr/bin/python3
"""A rospy node of a robot that starts, like launched_node.cpp: launched_node.py NUMBER NODES PORT."""

import socket
import sys
import time

import rospy
from std_msgs.msg import String

TOPICS, PARAMETERS = 5, 20


def main() -> None:
    number, nodes, port = map(int, sys.argv[1:4])
    rospy.init_node("launched_node")
    for one in range(PARAMETERS):
        rospy.get_param(f"~gain_{one}")
    seen = set()
    publishers = [
        rospy.Publisher(f"/launched/{number}/t{one}", String, queue_size=1) for one in range(TOPICS)
    ]
    for one in range(TOPICS):
        rospy.Subscriber(
            f"/launched/{(number + 1) % nodes}/t{one}", String, lambda _message, one=one: seen.add(one)
        )
    rate, reported = rospy.Rate(20), False
    while not rospy.is_shutdown():
        for publisher in publishers:
            publisher.publish("x")
        if not reported and len(seen) == TOPICS:
            text = f"{number} {time.monotonic():.6f}"
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(text.encode(), ("127.0.0.1", port))
            reported = True
        rate.sleep()


main()
