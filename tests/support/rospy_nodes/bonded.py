"""Run one end of a bond: bonded.py TOPIC ID. The events are `formed` and `broken`."""

import rospy
from bondpy import bondpy
from report import init_node, report

CONNECT_SECONDS = 120.0  # the other end may start slowly


def main():
    topic, name = rospy.myargv()[1:]
    init_node("bonded")
    bond = bondpy.Bond(topic, name, on_broken=lambda: report("broken"), on_formed=lambda: report("formed"))
    bond.connect_timeout = CONNECT_SECONDS
    bond.start()
    report("ready", name=rospy.get_name())
    rospy.spin()


if __name__ == "__main__":
    main()
