"""Run /landshark_turret, the gun: it takes joint commands and triggers, and publishes joint states and shots.

The driver fires wherever the gun points, even at the robot itself. Preventing that is the task of a monitor.
"""

import threading

import physics
import rospy
from landshark_messages import paintball_trigger
from sensor_msgs.msg import JointState
from std_msgs.msg import UInt32

HERTZ = 20.0
PaintballTrigger = paintball_trigger()
SHOTS = {
    PaintballTrigger.SINGLE_SHOT: 1,
    PaintballTrigger.TRIPLE_SHOT: 3,
    PaintballTrigger.BURST_SHOT: 8,
}


class TurretDriver:
    def __init__(self):
        self.lock = threading.Lock()
        self.turret = self.wanted = physics.Turret()
        self.fired = 0
        self.states = rospy.Publisher("/landshark/joint_states", JointState, queue_size=10)
        self.shots = rospy.Publisher("/landshark/shots", UInt32, queue_size=10, latch=True)
        self.shots.publish(0)
        rospy.Subscriber("/landshark_control/turret", JointState, self.command)
        rospy.Subscriber("/landshark_control/trigger", PaintballTrigger, self.fire)

    def command(self, message):
        angles = dict(zip(message.name, message.position))  # noqa: B905  a shorter list leaves joints alone
        with self.lock:
            self.wanted = physics.Turret(
                angles.get("turret_pan", self.wanted.pan), angles.get("turret_tilt", self.wanted.tilt)
            )

    def fire(self, message):
        shots = SHOTS.get(message.trigger, 0)
        with self.lock:
            self.fired += shots
            fired, turret = self.fired, self.turret
        if shots:
            rospy.loginfo("fired %d at pan %.2f, tilt %.2f", shots, turret.pan, turret.tilt)
            self.shots.publish(fired)

    def step(self, seconds):
        with self.lock:
            self.turret = physics.aim(self.turret, self.wanted, seconds)
            turret = self.turret
        message = JointState()
        message.header.stamp = rospy.Time.now()
        message.name = ["turret_pan", "turret_tilt"]
        message.position = [turret.pan, turret.tilt]
        self.states.publish(message)


def main():
    rospy.init_node("landshark_turret")
    driver = TurretDriver()
    rate = rospy.Rate(HERTZ)
    while not rospy.is_shutdown():
        driver.step(1 / HERTZ)
        try:
            rate.sleep()
        except rospy.ROSInterruptException:
            return


if __name__ == "__main__":
    main()
