"""Run /ocu, the operator control unit: drive out, aim, fire once, then patrol until a signal.

It prints one JSON object per line: `connected`, `drove` (metres), `aimed` (radians), `fired` (shots so far),
`position`, `lost` (the robot's odometry is late), and `regained` (the seconds until it arrived again).
"""

import threading
import time

import rospy
from geometry_msgs.msg import TwistStamped
from landshark_messages import paintball_trigger
from nav_msgs.msg import Odometry
from report import report
from sensor_msgs.msg import JointState, NavSatFix
from std_msgs.msg import UInt32

HERTZ = 10.0
LATE = 0.3  # seconds; the odometry comes twenty times a second
PaintballTrigger = paintball_trigger()


class Operator:
    def __init__(self):
        self.changed = threading.Condition()
        self.seen = {}
        self.odometry = 0.0  # monotonic time of the last odometry
        self.lost = False
        self.velocity = rospy.Publisher("/landshark_control/base_velocity", TwistStamped, queue_size=10)
        self.turret = rospy.Publisher("/landshark_control/turret", JointState, queue_size=10)
        self.trigger = rospy.Publisher("/landshark_control/trigger", PaintballTrigger, queue_size=10)
        for topic, kind in (
            ("/landshark/odom", Odometry),
            ("/landshark/gps", NavSatFix),
            ("/landshark/joint_states", JointState),
            ("/landshark/shots", UInt32),
        ):
            rospy.Subscriber(topic, kind, self.look, callback_args=topic)

    def look(self, message, topic):
        with self.changed:
            self.seen[topic] = message
            if topic == "/landshark/odom":
                before, self.odometry = self.odometry, time.monotonic()
                if self.lost:
                    self.lost = False
                    report("regained", seconds=round(self.odometry - before, 2))
            self.changed.notify_all()

    def wait(self, condition, seconds=30.0):
        with self.changed:
            return self.changed.wait_for(lambda: rospy.is_shutdown() or condition(self.seen), seconds)

    def connected(self):
        controls = (self.velocity, self.turret, self.trigger)
        return len(self.seen) == 4 and all(control.get_num_connections() for control in controls)

    def drive(self, forward, turn=0.0):
        """Send a velocity, which must be repeated within half a second."""
        message = TwistStamped()
        message.header.stamp = rospy.Time.now()
        message.twist.linear.x, message.twist.angular.z = forward, turn
        self.velocity.publish(message)

    def aim(self, pan, tilt):
        message = JointState()
        message.header.stamp = rospy.Time.now()
        message.name, message.position = ["turret_pan", "turret_tilt"], [pan, tilt]
        self.turret.publish(message)

    def fire(self):
        message = PaintballTrigger(trigger=PaintballTrigger.SINGLE_SHOT)
        message.header.stamp = rospy.Time.now()
        self.trigger.publish(message)

    def watch(self):
        with self.changed:
            if not self.lost and time.monotonic() - self.odometry > LATE:
                self.lost = True
                report("lost")

    def x(self):
        """Return the distance to the east in metres."""
        return self.seen["/landshark/odom"].pose.pose.position.x


def mission(operator, rate):
    """Report each step when the robot has done it, not when the command is sent."""
    start = operator.x()
    while not rospy.is_shutdown() and operator.x() < start + 3:
        operator.drive(1.0)
        rate.sleep()
    report("drove", metres=round(operator.x() - start, 2))

    operator.aim(0.4, 0.2)
    if operator.wait(lambda seen: abs(seen["/landshark/joint_states"].position[1] - 0.2) < 0.01):
        report("aimed", tilt=operator.seen["/landshark/joint_states"].position[1])

    before = operator.seen["/landshark/shots"].data
    operator.fire()
    if operator.wait(lambda seen: seen["/landshark/shots"].data > before):
        report("fired", shots=operator.seen["/landshark/shots"].data)


def main():
    rospy.init_node("ocu")
    operator = Operator()
    rate = rospy.Rate(HERTZ)
    try:
        while not operator.connected():
            rate.sleep()
        report("connected")
        mission(operator, rate)
        turns = 0
        while not rospy.is_shutdown():
            operator.drive(0.3, 0.5)
            operator.watch()
            if turns % HERTZ == 0:
                fix = operator.seen["/landshark/gps"]
                shots = operator.seen["/landshark/shots"].data
                report(
                    "position", latitude=fix.latitude, longitude=fix.longitude, x=operator.x(), shots=shots
                )
            turns += 1
            rate.sleep()
    except rospy.ROSInterruptException:
        pass


if __name__ == "__main__":
    main()
