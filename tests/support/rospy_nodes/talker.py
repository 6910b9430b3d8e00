"""Publish std_msgs/String: talker.py TOPIC [--latch] [--text T] [--rate HZ] [--count N] [--late SECONDS].

With `--late`, each answer to `requestTopic` comes so much later.
"""

import argparse
import sys
import threading

import rospy
from report import init_node, report
from rospy.impl.masterslave import ROSHandler
from std_msgs.msg import String


class Watch(rospy.SubscribeListener):
    def peer_subscribe(self, topic_name, topic_publish, peer_publish):
        report("connected", topic=topic_name)

    def peer_unsubscribe(self, topic_name, num_peers):
        report("disconnected", topic=topic_name, left=num_peers)


def answer_late(seconds):
    answer = ROSHandler.requestTopic

    def late(self, *parameters):
        threading.Event().wait(seconds)
        return answer(self, *parameters)

    ROSHandler.requestTopic = late


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("topic")
    arguments.add_argument("--latch", action="store_true")
    arguments.add_argument("--text", default="hello")
    arguments.add_argument("--rate", type=float, default=10)
    arguments.add_argument("--count", type=int, default=0)
    arguments.add_argument("--late", type=float, default=0)
    options = arguments.parse_args(rospy.myargv()[1:])
    if options.late:
        answer_late(options.late)
    init_node("talker")
    publisher = rospy.Publisher(options.topic, String, Watch(), latch=options.latch, queue_size=100)
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    rate = rospy.Rate(options.rate)
    number = 0
    while not rospy.is_shutdown():
        if number < (1 if options.latch else options.count or sys.maxsize):
            number += 1
            publisher.publish(f"{options.text} {number}")
            report("sent", number=number)
        try:
            rate.sleep()
        except rospy.ROSInterruptException:
            break
    report("ended")


if __name__ == "__main__":
    main()
