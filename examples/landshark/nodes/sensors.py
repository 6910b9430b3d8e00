"""Run one of the LandShark's sensors as a node: `sensors.py gps`, `sensors.py laser`, `sensors.py battery`.

Each simulated sensor subscribes to the odometry, where a real one would measure the world.
"""

import math
import sys

import physics
import rospy
from nav_msgs.msg import Odometry
from sensor_msgs.msg import BatteryState, LaserScan, NavSatFix, NavSatStatus

BEAMS = 61
FIELD_OF_VIEW = math.radians(120)


class Gps:
    topic, kind = "/landshark/gps", NavSatFix

    def measure(self, odometry):
        message = NavSatFix()
        message.header.stamp, message.header.frame_id = odometry.header.stamp, "gps"
        message.status.status, message.status.service = NavSatStatus.STATUS_FIX, NavSatStatus.SERVICE_GPS
        message.latitude, message.longitude = physics.position_on_earth(physics.pose_of(odometry))
        return message


class Laser:
    topic, kind = "/landshark/scan", LaserScan

    def measure(self, odometry):
        step = FIELD_OF_VIEW / (BEAMS - 1)
        directions = [-FIELD_OF_VIEW / 2 + step * beam for beam in range(BEAMS)]
        message = LaserScan()
        message.header.stamp, message.header.frame_id = odometry.header.stamp, "laser"
        message.angle_min, message.angle_max, message.angle_increment = directions[0], directions[-1], step
        message.range_min, message.range_max = 0.05, 30.0
        message.ranges = physics.scan(physics.pose_of(odometry), directions)
        return message


class Battery:
    topic, kind = "/landshark/battery", BatteryState

    def __init__(self):
        self.charge = 1.0
        self.last = None

    def measure(self, odometry):
        now = odometry.header.stamp
        seconds = (now - self.last).to_sec() if self.last else 0.0
        self.last = now
        self.charge = physics.drained(self.charge, odometry.twist.twist.linear.x, max(seconds, 0.0))
        message = BatteryState()
        message.header.stamp = now
        message.percentage, message.voltage, message.present = self.charge, 22.0 + 4.0 * self.charge, True
        message.current = message.capacity = message.design_capacity = float("nan")  # not measured
        return message


SENSORS = {"gps": (Gps, 5.0), "laser": (Laser, 10.0), "battery": (Battery, 1.0)}


def main():
    arguments = rospy.myargv()[1:]
    if len(arguments) != 1 or arguments[0] not in SENSORS:
        sys.exit(f"usage: sensors.py {'|'.join(SENSORS)}")
    name = arguments[0]
    make, hertz = SENSORS[name]
    rospy.init_node(f"landshark_{name}")
    sensor = make()
    publisher = rospy.Publisher(sensor.topic, sensor.kind, queue_size=10)
    latest = []
    rospy.Subscriber("/landshark/odom", Odometry, lambda message: latest.__setitem__(slice(None), [message]))
    rate = rospy.Rate(hertz)
    while not rospy.is_shutdown():
        if latest:
            publisher.publish(sensor.measure(latest[0]))
        try:
            rate.sleep()
        except rospy.ROSInterruptException:
            return


if __name__ == "__main__":
    main()
