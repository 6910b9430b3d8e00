"""A typed relay in rospy, like a monitor written in Python: `rospy_relay.py IN OUT` (run by Debian's Python)."""

import sys
from pathlib import Path

import genpy.dynamic
import rospy

TYPE = "relay_load/Sample"


def main():
    given, taken = rospy.myargv(sys.argv)[1:]
    text = (Path(__file__).parent / "msg" / f"{TYPE}.msg").read_text()
    sample = genpy.dynamic.generate_dynamic(TYPE, text)[TYPE]
    rospy.init_node("rospy_relay", anonymous=True)
    publisher = rospy.Publisher(taken, sample, queue_size=100)

    def relay(message):
        if message.value > 0.5:
            message.value = message.number % 2 / 2
        publisher.publish(message)

    rospy.Subscriber(given, sample, relay, queue_size=100)
    rospy.spin()


if __name__ == "__main__":
    main()
