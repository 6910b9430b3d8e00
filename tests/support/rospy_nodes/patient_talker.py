"""Wait for the first subscriber, publish one message and stay: patient_talker.py TOPIC."""

import argparse

import rospy
from report import report
from std_msgs.msg import String


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("topic")
    options = arguments.parse_args(rospy.myargv()[1:])
    # Not `report.init_node`: after rospy's own, slower end the next publisher finds that listeners have dropped this
    # one.
    rospy.init_node("patient_talker")
    publisher = rospy.Publisher(options.topic, String, queue_size=10)
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    while not publisher.get_num_connections() and not rospy.is_shutdown():
        rospy.sleep(0.001)
    publisher.publish("hello 1")
    report("sent", number=1)
    rospy.spin()
    report("ended")


if __name__ == "__main__":
    main()
