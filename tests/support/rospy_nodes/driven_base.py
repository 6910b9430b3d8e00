"""A base on /cmd_vel with odometry on /odom: driven_base.py TIMEOUT.

It obeys a command for TIMEOUT seconds. A TIMEOUT of 0 means until the next command. It prints the events `moves` and
`stands` when its speed changes, and `silent` after 0.3 s without a command.
"""

import sys
import threading

import rospy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from report import init_node, report


class Base:
    def __init__(self, timeout):
        self.timeout = timeout
        self.speed = 0.0
        self.at = 0.0
        self.quiet = True
        self.lock = threading.Lock()

    def obey(self, command):
        with self.lock:
            now, speed = rospy.get_time(), command.linear.x
            if (speed == 0) != (self.speed == 0) or self.quiet:
                report("moves" if speed else "stands", speed=speed, silent=now - self.at)
            self.speed, self.at, self.quiet = speed, now, False

    def measured(self):
        with self.lock:
            since = rospy.get_time() - self.at
            if since > 0.3 and not self.quiet:
                self.quiet = True
                report("silent")
            if self.timeout and since > self.timeout:
                self.speed = 0.0
            odometry = Odometry()
            odometry.twist.twist.linear.x = self.speed
            return odometry


def main():
    init_node("driven_base")
    base = Base(float(rospy.myargv()[1]))
    rospy.Subscriber("/cmd_vel", Twist, base.obey, tcp_nodelay=True)
    publisher = rospy.Publisher("/odom", Odometry, queue_size=10)
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    rate = rospy.Rate(50)
    while not rospy.is_shutdown():
        publisher.publish(base.measured())
        try:
            rate.sleep()
        except rospy.ROSInterruptException:
            break
    report("ended")


if __name__ == "__main__":
    sys.exit(main())
