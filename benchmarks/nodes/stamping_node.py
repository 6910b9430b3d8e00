"""Publish messages with timestamps, or report their arrival (run by Debian's Python, with rospy).

`stamping_node.py publish TOPIC BYTES HZ SECONDS` ends after SECONDS; with HZ 0 it publishes as fast as the connection
takes messages. `stamping_node.py subscribe TOPIC` answers each line of its input with a line `{"event": "counted",
"received": N, "seconds": S, "delays": [µs, …]}` about the messages since the last one. The clock is CLOCK_MONOTONIC,
which both processes share.
"""

import json
import sys
import threading
import time

import rospy
from std_msgs.msg import String

NANOSECONDS = 1_000_000_000


def publish(topic, size, hertz, seconds):
    publisher = rospy.Publisher(topic, String, queue_size=None)
    while not publisher.get_num_connections() and not rospy.is_shutdown():
        threading.Event().wait(0.05)
    padding = "x" * max(0, size - 24)
    end = time.monotonic() + seconds
    rate = rospy.Rate(hertz) if hertz else None
    while time.monotonic() < end and not rospy.is_shutdown():
        publisher.publish(f"{time.monotonic_ns()} {padding}")
        if rate is not None:
            rate.sleep()


def subscribe(topic):
    seen = []
    rospy.Subscriber(topic, String, lambda message: seen.append((time.monotonic_ns(), message.data[:20])))
    print(json.dumps({"event": "ready"}), flush=True)
    for _ in sys.stdin:
        taken, seen[:] = list(seen), []
        spent = (taken[-1][0] - taken[0][0]) / NANOSECONDS if taken else 0.0
        delays = [(moment - int(text.split()[0])) / 1000 for moment, text in taken]
        print(
            json.dumps(
                {"event": "counted", "received": len(taken), "seconds": spent, "delays": delays[-5000:]}
            ),
            flush=True,
        )


def main():
    words = rospy.myargv()[1:]
    rospy.init_node(f"stamping_{words[0]}", anonymous=True)
    if words[0] == "publish":
        publish(words[1], int(words[2]), float(words[3]), float(words[4]))
    else:
        subscribe(words[1])


if __name__ == "__main__":
    main()
