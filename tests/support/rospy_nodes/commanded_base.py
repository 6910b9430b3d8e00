"""Print each command on /cmd_vel, with its publisher and speed, and when it came in seconds of the machine."""

import time

import rospy
from geometry_msgs.msg import Twist
from report import init_node, report


def heard(command):
    report(
        "received",
        publisher=command._connection_header["callerid"],
        speed=command.linear.x,
        at=time.monotonic(),
    )


def main():
    init_node("commanded_base")
    rospy.Subscriber("/cmd_vel", Twist, heard, tcp_nodelay=True)
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    rospy.spin()
    report("ended")


if __name__ == "__main__":
    main()
