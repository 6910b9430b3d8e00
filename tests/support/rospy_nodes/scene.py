"""Publish what a screen shows: `/tf` and `/odom` 50 times a second, and a latched `/map`."""

import rospy
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from report import init_node, report
from tf2_msgs.msg import TFMessage

HERTZ, SIDE = 50, 100


def main():
    init_node("scene")
    map_publisher = rospy.Publisher("/map", OccupancyGrid, queue_size=1, latch=True)
    transforms = rospy.Publisher("/tf", TFMessage, queue_size=10)
    odometry = rospy.Publisher("/odom", Odometry, queue_size=10)
    grid = OccupancyGrid()
    grid.header.frame_id = "map"
    grid.info.resolution, grid.info.width, grid.info.height = 0.1, SIDE, SIDE
    grid.info.origin.orientation.w = 1.0
    grid.data = [0] * SIDE * SIDE
    map_publisher.publish(grid)
    report("ready", name=rospy.get_name())
    rate = rospy.Rate(HERTZ)
    while not rospy.is_shutdown():
        pose = TransformStamped(child_frame_id="base")
        pose.header.stamp, pose.header.frame_id, pose.transform.rotation.w = rospy.Time.now(), "map", 1.0
        transforms.publish(TFMessage([pose]))
        moved = Odometry(header=pose.header, child_frame_id="base")
        moved.pose.pose.orientation.w = 1.0
        odometry.publish(moved)
        try:
            rate.sleep()
        except rospy.ROSInterruptException:
            break


if __name__ == "__main__":
    main()
