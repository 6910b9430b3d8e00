"""Command /cmd_vel by lines: a speed is sent twenty times a second, 0 once, and after `silent` nothing is.

Each change of the speed is reported when it is first sent, in seconds of the machine.
"""

import sys
import time

import rospy
from geometry_msgs.msg import Twist
from report import init_node, report


def main():
    init_node("stick")
    publisher = rospy.Publisher("/cmd_vel", Twist, queue_size=10, tcp_nodelay=True)
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    speed = [None]
    said = [None]

    def send(value):
        command = Twist()
        command.linear.x = value
        if said[0] != value:
            said[0] = value
            report("commanded", speed=value, at=time.monotonic())
        publisher.publish(command)

    def publish(_event):
        if speed[0] is not None:
            send(speed[0])

    rospy.Timer(rospy.Duration(0.05), publish)
    for line in sys.stdin:
        word = line.strip()
        speed[0] = None if word in ("silent", "0") else float(word)
        if word == "0":
            send(0.0)
        report("told", speed=word)
    report("ended")


if __name__ == "__main__":
    main()
