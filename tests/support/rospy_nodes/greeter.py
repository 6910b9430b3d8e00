"""Send std_msgs/String `map N` to each new subscriber alone, as costmap_2d sends its map: greeter.py TOPIC."""

import itertools

import rospy
from report import init_node, report
from std_msgs.msg import String


class Greet(rospy.SubscribeListener):
    numbers = itertools.count(1)

    def peer_subscribe(self, _topic_name, _topic_publish, peer_publish):
        number = next(self.numbers)
        peer_publish(String(f"map {number}"))
        report("greeted", number=number)


def main():
    init_node("greeter")
    rospy.Publisher(rospy.myargv()[1], String, Greet(), queue_size=10)
    report("ready", name=rospy.get_name())
    rospy.spin()


if __name__ == "__main__":
    main()
