"""Report when each message of a topic came, in seconds of the machine: edge_listener.py TOPIC."""

import time

import rospy
from report import init_node, report


def main():
    init_node("edge_listener")
    rospy.Subscriber(
        rospy.myargv()[1],
        rospy.AnyMsg,
        lambda message: report("edge", at=time.monotonic(), level=message._buff[0]),
        tcp_nodelay=True,
    )
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    rospy.spin()


if __name__ == "__main__":
    main()
