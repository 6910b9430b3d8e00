"""Cut an operator's commands at full speed, with two nodes of Debian's rospy: `cut_node.py COUNT SILENT`.

One node commands full speed on `/cmd_vel` 50 times a second, then falls silent without closing its connection. The
program prints `{"event": "measured", "late": [...]}`: milliseconds from the `publish` of the last command until the
base's callback for the stop, minus SILENT (seconds).
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

PERIOD, COMMANDS, PATIENCE = 0.02, 20, 5.0  # the guard lets a motion pass after 0.2 s of commands
ARRIVED = struct.Struct("dd")
NAMES = [word for word in sys.argv if word.startswith("__")]


def base(arrivals):
    def arrived(command):
        os.write(arrivals, ARRIVED.pack(time.monotonic(), command.linear.x))

    rospy.init_node("base", argv=NAMES, anonymous=True, disable_signals=True)
    subscriber = rospy.Subscriber("/cmd_vel", Twist, arrived, tcp_nodelay=True)
    sys.stdin.read()
    del subscriber


def next_of(arrivals, speed):
    while select.select([arrivals], [], [], PATIENCE)[0]:
        at, found = ARRIVED.unpack(os.read(arrivals, ARRIVED.size))
        if found == speed:
            return at
    return None


def cut(publisher, arrivals, number, silent, pause):
    command = Twist()
    for place in range(COMMANDS):
        if place:
            pause.wait(PERIOD)
        command.linear.x = 1.0 + number + place / 128
        last = time.monotonic()
        publisher.publish(command)
    if next_of(arrivals, command.linear.x) is None:
        return None
    stopped = next_of(arrivals, 0.0)
    return None if stopped is None else (stopped - last - silent) * 1e3


def main():
    arrivals, writer = os.pipe()
    end, alive = os.pipe()
    if not os.fork():
        os.close(alive)
        os.dup2(end, 0)
        base(writer)
        os._exit(0)
    rospy.init_node("operator", argv=NAMES, anonymous=True)
    publisher = rospy.Publisher("/cmd_vel", Twist, queue_size=10, tcp_nodelay=True)
    pause = threading.Event()
    for _ in range(100):
        if publisher.get_num_connections():
            break
        pause.wait(0.1)
    pause.wait(1.0)
    silent = float(sys.argv[2])
    late = [cut(publisher, arrivals, number, silent, pause) for number in range(int(sys.argv[1]))]
    print(json.dumps({"event": "measured", "late": late}), flush=True)


if __name__ == "__main__":
    main()
