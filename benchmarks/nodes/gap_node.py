"""Report the gaps of a topic (run by Debian's Python): gap_node.py TOPIC.

It prints `{"event": "first"}` at the first message, and `{"event": "gap", "began": …, "ended": …}` (seconds of the
monotonic clock) whenever two messages are more than 50 ms apart.
"""

import json
import sys
import time

import rospy

LEAST = 0.05
TIMES = []


def arrived(_message):
    now = time.monotonic()
    if not TIMES:
        print(json.dumps({"event": "first"}), flush=True)
    elif now - TIMES[-1] > LEAST:
        print(json.dumps({"event": "gap", "began": TIMES[-1], "ended": now}), flush=True)
    TIMES[:] = [now]


def main():
    rospy.init_node("gap_node")
    subscriber = rospy.Subscriber(sys.argv[1], rospy.AnyMsg, arrived, tcp_nodelay=True)
    rospy.spin()
    del subscriber


if __name__ == "__main__":
    main()
