"""Command 0.2 m/s on /cmd_vel twenty times a second."""

import rospy
from geometry_msgs.msg import Twist
from report import init_node, report


def main():
    init_node("driver")
    publisher = rospy.Publisher("/cmd_vel", Twist, queue_size=10, tcp_nodelay=True)
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    command = Twist()
    command.linear.x = 0.2
    rate = rospy.Rate(20)
    while not rospy.is_shutdown():
        publisher.publish(command)
        try:
            rate.sleep()
        except rospy.ROSInterruptException:
            break
    report("ended")


if __name__ == "__main__":
    main()
