"""Publish `/clock` a thousand times a second, as Gazebo does, and stop and go on by `pause` and `go` on standard input.

The event `paused` has the ROS time at which the clock stands.
"""

import sys
import threading

import rospy
from report import init_node, report
from rosgraph_msgs.msg import Clock

STEP_SECONDS = 0.001


def main():
    init_node("sim_clock")
    runs, ended = threading.Event(), threading.Event()
    runs.set()
    publisher = rospy.Publisher("/clock", Clock, queue_size=100)
    now = [100.0]

    def tick():
        while not ended.wait(STEP_SECONDS):
            if runs.is_set():
                now[0] += STEP_SECONDS
                publisher.publish(Clock(rospy.Time.from_sec(now[0])))

    threading.Thread(target=tick, daemon=True).start()
    report("ready", name=rospy.get_name())
    for line in sys.stdin:
        if line.strip() == "pause":
            runs.clear()
            report("paused", now=now[0])
        else:
            runs.set()
    ended.set()


if __name__ == "__main__":
    main()
