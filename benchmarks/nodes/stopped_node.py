"""Measure how late commands and stops arrive, with two rospy nodes (run by Debian's Python): `stopped_node.py COUNT`.

One node publishes in turns a command (`/drive`), which a monitor changes, and a scan (`/scan`), for which a monitor
publishes a stop (`/cmd_vel`). The other receives both, because a node's messages to itself never leave its process.
The program prints `{"event": "measured", "changed": [...], "stopped": [...]}`: milliseconds from `publish` until the
callback.
"""

import json
import os
import select
import struct
import sys
import threading
import time

import rospy
from geometry_msgs.msg import Twist
from sensor_msgs.msg import LaserScan

PAUSE = 0.007
LIMIT = 5.0
ARRIVED = struct.Struct("d")
NAMES = [word for word in sys.argv if word.startswith("__")]


def receive(arrivals):
    def arrived(_command):
        os.write(arrivals, ARRIVED.pack(time.monotonic()))

    rospy.init_node("driving_node", argv=NAMES, anonymous=True, disable_signals=True)
    subscribers = [
        rospy.Subscriber(topic, Twist, arrived, tcp_nodelay=True) for topic in ("/drive", "/cmd_vel")
    ]
    sys.stdin.read()
    del subscribers


def measure(publisher, message, arrivals, patience=LIMIT):
    began = time.monotonic()
    publisher.publish(message)
    if not select.select([arrivals], [], [], patience)[0]:
        return None
    return (ARRIVED.unpack(os.read(arrivals, ARRIVED.size))[0] - began) * 1e3


def main():
    arrivals, writer = os.pipe()
    end, alive = os.pipe()
    if not os.fork():
        os.close(alive)
        os.dup2(end, 0)
        receive(writer)
        os._exit(0)
    rospy.init_node("stopped_node", argv=NAMES, anonymous=True)
    drive = Twist()
    drive.linear.x = 3.0
    messages = {"/drive": drive, "/scan": LaserScan(ranges=[0.1])}
    paths = {
        topic: (rospy.Publisher(topic, type(message), queue_size=10, tcp_nodelay=True), message)
        for topic, message in messages.items()
    }
    for path in paths.values():
        while measure(*path, arrivals, 0.2) is None:
            pass
    took = {topic: [] for topic in paths}
    pause = threading.Event()
    for _ in range(int(sys.argv[1])):
        for topic, path in paths.items():
            pause.wait(PAUSE)
            took[topic].append(measure(*path, arrivals))
    print(json.dumps({"event": "measured", "changed": took["/drive"], "stopped": took["/scan"]}), flush=True)


if __name__ == "__main__":
    main()
