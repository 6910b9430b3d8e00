import argparse

import rospy
from report import init_node, report
from std_msgs.msg import String


def heard(message):
    report("received", data=message.data, publisher=message._connection_header["callerid"])


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("topic")
    options = arguments.parse_args(rospy.myargv()[1:])
    init_node("listener")
    rospy.Subscriber(options.topic, String, heard)
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    rospy.spin()
    report("ended")


if __name__ == "__main__":
    main()
