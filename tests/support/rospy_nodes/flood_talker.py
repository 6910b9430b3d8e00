"""Publish numbered std_msgs/String: flood_talker.py TOPIC [--rate HZ] [--bytes N].

A line on the input ends the flood. The event `flooded` has the number of messages.
"""

import argparse
import sys
import threading

import rospy
from report import init_node, report
from std_msgs.msg import String


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("topic")
    arguments.add_argument("--rate", type=float, default=1000)
    arguments.add_argument("--bytes", type=int, default=2000)
    options = arguments.parse_args(rospy.myargv()[1:])
    init_node("flood_talker")
    publisher = rospy.Publisher(options.topic, String, queue_size=None, tcp_nodelay=True)
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.readline(), ended.set()), daemon=True).start()
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    while not publisher.get_num_connections():
        rospy.sleep(0.01)
    filling, number, rate = "." * options.bytes, 0, rospy.Rate(options.rate)
    while not ended.is_set() and not rospy.is_shutdown():
        number += 1
        publisher.publish(f"{number} {filling}")
        rate.sleep()
    report("flooded", last=number)
    rospy.spin()
    report("ended")


if __name__ == "__main__":
    main()
