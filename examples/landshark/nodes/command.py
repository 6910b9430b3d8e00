"""Give one command of an operator.

    command.py drive FORWARD TURN SECONDS | dash FORWARD | reach X Y | aim PAN TILT | fire

Positions are in metres, speeds in metres and radians a second, angles in radians. The program prints one JSON object:
`drove` (the position at the end), `dashing` (the program continues to drive), `reached` (the path, whether the robot
arrived, its smallest distance from the obstacle's edge, negative inside, and its largest distance from the origin),
`aimed` (the angle), or `fired` (the shots so far). A message that is published once is latched for a while, as with
`rostopic pub -1`.
"""

import math
import sys
import threading

import physics
import rospy
from geometry_msgs.msg import TwistStamped
from landshark_messages import paintball_trigger
from nav_msgs.msg import Odometry
from report import report
from sensor_msgs.msg import JointState
from std_msgs.msg import UInt32

HERTZ = 10
SECONDS = 10.0  # a driver that has not connected by then will not connect
SETTLED = 1.0
THERE = 0.5  # metres
STEERED = 0.3  # radians off course; beyond this the robot only turns
STUCK = 2.0  # seconds without getting nearer
UNDER_WAY = 60.0  # seconds at most
LATCHED = 1.5


class Display:
    def __init__(self, topic, kind):
        self.message = None
        self.changed = threading.Condition()
        rospy.Subscriber(topic, kind, self.show)

    def show(self, message):
        with self.changed:
            self.message = message
            self.changed.notify_all()

    def wait(self, condition, seconds=SECONDS):
        with self.changed:
            return self.changed.wait_for(
                lambda: self.message is not None and condition(self.message), seconds
            )


def connected(publisher):
    rate = rospy.Rate(HERTZ)
    for _ in range(int(SECONDS * HERTZ)):
        if publisher.get_num_connections():
            return publisher
        rate.sleep()
    sys.exit(f"command.py: no node subscribes to {publisher.name}")


def drive(forward, turn, seconds):
    display = Display("/landshark/odom", Odometry)
    publisher = connected(rospy.Publisher("/landshark_control/base_velocity", TwistStamped, queue_size=10))
    rate = rospy.Rate(HERTZ)
    for _ in range(int(seconds * HERTZ)):
        message = TwistStamped()
        message.header.stamp = rospy.Time.now()
        message.twist.linear.x, message.twist.angular.z = forward, turn
        publisher.publish(message)
        rate.sleep()
    display.wait(lambda odometry: odometry.twist.twist.linear.x == 0 and odometry.twist.twist.angular.z == 0)
    position = display.message.pose.pose.position
    report("drove", x=round(position.x, 2), y=round(position.y, 2))


def dash(forward):
    display = Display("/landshark/odom", Odometry)
    publisher = connected(rospy.Publisher("/landshark_control/base_velocity", TwistStamped, queue_size=10))
    display.wait(lambda _odometry: True)
    begin, rate, dashing = physics.pose_of(display.message), rospy.Rate(HERTZ), False
    for _ in range(int(UNDER_WAY * HERTZ)):
        message = TwistStamped()
        message.header.stamp = rospy.Time.now()
        message.twist.linear.x = forward
        publisher.publish(message)
        pose = physics.pose_of(display.message)
        if not dashing and math.hypot(pose.x - begin.x, pose.y - begin.y) > 1.0:
            dashing = True
            report("dashing", x=round(pose.x, 2))
        rate.sleep()


def reach(x, y):
    """Drive to a position at top speed. Give up when the robot stops getting nearer."""
    display = Display("/landshark/odom", Odometry)
    publisher = connected(rospy.Publisher("/landshark_control/base_velocity", TwistStamped, queue_size=10))
    display.wait(lambda _odometry: True)
    rate, way, nearest, stuck = rospy.Rate(HERTZ), [], math.inf, 0
    for _ in range(int(UNDER_WAY * HERTZ)):
        pose = physics.pose_of(display.message)
        way.append(pose)
        away = math.hypot(x - pose.x, y - pose.y)
        off = physics.normal_angle(math.atan2(y - pose.y, x - pose.x) - pose.heading)
        turning = abs(off) > STEERED
        stuck = 0 if turning or away < nearest - 0.01 else stuck + 1
        nearest = min(nearest, away)
        if nearest < THERE or stuck > STUCK * HERTZ:
            break
        message = TwistStamped()
        message.header.stamp = rospy.Time.now()
        message.twist.linear.x, message.twist.angular.z = 0.0 if turning else physics.TOP_SPEED, 2 * off
        publisher.publish(message)
        rate.sleep()
    things = [(pose, thing) for pose in way for thing in physics.YARD]
    report(
        "reached",
        there=nearest < THERE,
        to_obstacle=round(min(math.dist((at.x, at.y), (it.x, it.y)) - it.radius for at, it in things), 2),
        farthest=round(max(math.hypot(pose.x, pose.y) for pose in way), 2),
        way=[(round(pose.x, 2), round(pose.y, 2)) for pose in way],
    )


def aim(pan, tilt):
    display = Display("/landshark/joint_states", JointState)
    publisher = connected(rospy.Publisher("/landshark_control/turret", JointState, queue_size=10, latch=True))
    message = JointState(name=["turret_pan", "turret_tilt"], position=[pan, tilt])
    message.header.stamp = rospy.Time.now()
    publisher.publish(message)
    display.wait(lambda joints: abs(joints.position[1] - tilt) < 0.01)
    report("aimed", tilt=round(display.message.position[1], 2))


def fire():
    kind = paintball_trigger()
    display = Display("/landshark/shots", UInt32)
    publisher = connected(rospy.Publisher("/landshark_control/trigger", kind, queue_size=10, latch=True))
    display.wait(lambda _shots: True)
    before = display.message.data
    message = kind(trigger=kind.SINGLE_SHOT)
    message.header.stamp = rospy.Time.now()
    publisher.publish(message)
    display.wait(lambda shots: shots.data > before, SETTLED)
    report("fired", shots=display.message.data, before=before)


def main():
    what, *values = rospy.myargv()[1:] or ["nothing"]
    actions = {
        "drive": (drive, 3),
        "dash": (dash, 1),
        "reach": (reach, 2),
        "aim": (aim, 2),
        "fire": (fire, 0),
    }
    if what not in actions or len(values) != actions[what][1]:
        sys.exit(
            "usage: command.py drive FORWARD TURN SECONDS | dash FORWARD | reach X Y | aim PAN TILT | fire"
        )
    rospy.init_node("ocu")
    actions[what][0](*map(float, values))
    rospy.sleep(LATCHED)


if __name__ == "__main__":
    main()
