"""Sleep 0.1 s of ROS time again and again: the event `slept` has the ROS time after it, in seconds."""

import rospy
from report import init_node, report


def main():
    init_node("sleeper")
    report("ready", name=rospy.get_name())
    while not rospy.is_shutdown():
        try:
            rospy.sleep(0.1)
        except rospy.ROSInterruptException:
            break
        report("slept", now=rospy.get_time())


if __name__ == "__main__":
    main()
