"""Count messages of `frame_talker.py`: frame_listener.py COMMANDS PUBLISHER TOPIC...

Each motion on COMMANDS is an event `moves`, with its time in seconds of the machine: a Twist that is not zero, or
any long message. For each line on the input, `counted` has the number of messages of PUBLISHER on each topic. Bytes
that are all 255 do not count.
"""

import sys
import time

import rospy
from report import init_node, report

TWIST = 48  # bytes


def main():
    init_node("frame_listener")
    commands, publisher, *topics = rospy.myargv()[1:]
    heard = dict.fromkeys(topics, 0)

    def moved(message):
        data = message._buff
        if any(data) if len(data) == TWIST else len(data) > 2 * TWIST:
            report("moves", at=time.monotonic())

    def count(message, topic):
        if message._connection_header["callerid"] == publisher:
            heard[topic] += bool(message._buff.strip(b"\xff"))

    rospy.Subscriber(commands, rospy.AnyMsg, moved, tcp_nodelay=True)
    for topic in topics:
        rospy.Subscriber(topic, rospy.AnyMsg, count, topic, tcp_nodelay=True)
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    for _line in sys.stdin:
        report("counted", heard=heard)
    rospy.spin()


if __name__ == "__main__":
    main()
