"""Run /landshark_base, the motors: it takes velocity commands and publishes odometry. It stops when commands cease.

With the arguments `runaway HEADING` it does not stop, like many real drivers, and reports its motion.
"""

import math
import threading

import physics
import rospy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from report import report

HERTZ = 20.0


class Base:
    def __init__(self, heading=None):
        self.lock = threading.Lock()
        self.runaway = heading is not None
        self.pose = physics.Pose(heading=heading or 0.0)
        self.velocity = physics.Velocity()
        self.told = rospy.Time(0)
        self.odometry = rospy.Publisher("/landshark/odom", Odometry, queue_size=10)
        rospy.Subscriber("/landshark_control/base_velocity", TwistStamped, self.command)

    def command(self, message):
        with self.lock:
            self.velocity = physics.possible(
                physics.Velocity(message.twist.linear.x, message.twist.angular.z)
            )
            self.told = rospy.Time.now()

    def step(self, seconds):
        now = rospy.Time.now()
        with self.lock:
            if not self.runaway and (now - self.told).to_sec() > physics.COMMAND_LIFETIME:
                self.velocity = physics.Velocity()
            self.pose = physics.drive(self.pose, self.velocity, seconds)
            pose, velocity = self.pose, self.velocity
        message = Odometry()
        message.header.stamp = now
        message.header.frame_id, message.child_frame_id = "odom", "base_link"
        message.pose.pose.position.x, message.pose.pose.position.y = pose.x, pose.y
        message.pose.pose.orientation.z = math.sin(pose.heading / 2)
        message.pose.pose.orientation.w = math.cos(pose.heading / 2)
        message.twist.twist.linear.x, message.twist.twist.angular.z = velocity.forward, velocity.turn
        self.odometry.publish(message)
        if self.runaway:
            report("moved", x=round(pose.x, 2), y=round(pose.y, 2), speed=round(velocity.forward, 2))


def main():
    rospy.init_node("landshark_base")
    base = Base(*map(float, rospy.myargv()[2:]))
    rate = rospy.Rate(HERTZ)
    while not rospy.is_shutdown():
        base.step(1 / HERTZ)
        try:
            rate.sleep()
        except rospy.ROSInterruptException:
            return


if __name__ == "__main__":
    main()
