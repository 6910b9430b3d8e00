"""Measure how late messages arrive, with two rospy nodes (run by Debian's Python).

`stopped_node.py COUNT`: one node publishes in turns a command (`/drive`), which a monitor changes, and a scan
(`/scan`), for which a monitor publishes a stop (`/cmd_vel`). The other receives both, because a node's messages to
itself never leave its process. `stopped_node.py COUNT RAYS TOPIC...`: one node publishes in turns a scan on each topic,
each after a motion on TOPIC_command. The other receives the scans. The program prints `{"event": "measured", "took":
{TOPIC: [...]}}`: milliseconds from `publish` until the callback.
"""

import json
import math
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
COUNT, *WORDS = [word for word in sys.argv[1:] if ":=" not in word]
STOPS = {"/drive": Twist, "/cmd_vel": Twist}


def receive(arrivals):
    def arrived(_command):
        os.write(arrivals, ARRIVED.pack(time.monotonic()))

    rospy.init_node("driving_node", argv=NAMES, anonymous=True, disable_signals=True)
    heard = dict.fromkeys(WORDS[1:], LaserScan) or STOPS
    subscribers = [rospy.Subscriber(topic, kind, arrived, tcp_nodelay=True) for topic, kind in heard.items()]
    sys.stdin.read()
    del subscribers


def measure(publisher, message, arrivals, patience=LIMIT):
    began = time.monotonic()
    publisher.publish(message)
    if not select.select([arrivals], [], [], patience)[0]:
        return None
    return (ARRIVED.unpack(os.read(arrivals, ARRIVED.size))[0] - began) * 1e3


def room(rays):
    """Return a scan of a round scanner in a room of 10 m."""
    ranges = [5 + ray * 7 % 11 / 100 for ray in range(rays)]
    step = 2 * math.pi / rays
    return LaserScan(angle_min=-math.pi, angle_increment=step, range_min=0.1, range_max=30.0, ranges=ranges)


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
    if WORDS:
        messages = dict.fromkeys(WORDS[1:], room(int(WORDS[0])))
    commands = {
        topic: rospy.Publisher(f"{topic}_command", Twist, queue_size=10, tcp_nodelay=True)
        for topic in WORDS[1:]
    }
    paths = {
        topic: (rospy.Publisher(topic, type(message), queue_size=10, tcp_nodelay=True), message)
        for topic, message in messages.items()
    }
    for path in paths.values():
        while measure(*path, arrivals, 0.2) is None:
            pass
    took = {topic: [] for topic in paths}
    pause = threading.Event()
    motion = Twist()
    motion.linear.x = 0.2
    for _ in range(int(COUNT)):
        for topic, path in paths.items():
            if topic in commands:
                commands[topic].publish(motion)
            pause.wait(PAUSE)
            took[topic].append(measure(*path, arrivals))
    print(json.dumps({"event": "measured", "took": took}), flush=True)


if __name__ == "__main__":
    main()
