"""Sleep 0.1 s of ROS time again and again: the event `slept` has the ROS time after it, in seconds.

The event `back` has the seconds by which time went back; `rospy.sleep` may raise an exception then, and ends the node.
With `--stutter`, it stops reading for 0.3 s after each 400 messages of the clock, as on a busy machine.
"""

import sys
import threading

import rospy
from report import init_node, report
from rosgraph_msgs.msg import Clock


def main():
    init_node("sleeper")
    latest, heard, stutters = [0.0], [0], "--stutter" in sys.argv

    def hear(message):
        now = message.clock.to_sec()
        if now < latest[0]:
            report("back", seconds=latest[0] - now)
        latest[0] = now
        heard[0] += 1
        if stutters and heard[0] % 400 == 0:
            threading.Event().wait(0.3)

    rospy.Subscriber("/clock", Clock, hear)
    report("ready", name=rospy.get_name())
    while not rospy.is_shutdown():
        try:
            rospy.sleep(0.1)
        except rospy.ROSInterruptException:
            break
        report("slept", now=rospy.get_time())


if __name__ == "__main__":
    main()
