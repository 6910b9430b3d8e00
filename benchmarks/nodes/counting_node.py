"""The thesis's node: publish ten times a second, and count sent and received messages (run by Debian's Python).

`counting_node.py SECONDS [publish:=TOPIC] [subscribe:=TOPIC]` publishes from its start, even without a subscriber, as
the thesis's node did. A second after the last message it prints `{"event": "counted", "sent": …, "received": …,
"lost": …}`. Lost messages are those missing between the first and the last received one.
"""

import json
import sys
import threading

import rospy
from std_msgs.msg import String

HERTZ = 10
LINGER = 1.0


def main():
    words = dict(word.split(":=", 1) for word in sys.argv[1:] if ":=" in word and word[0] != "_")
    seconds = float(sys.argv[1])
    rospy.init_node("counting_node", argv=[word for word in sys.argv if word.startswith("__")])
    received = []
    if "subscribe" in words:
        rospy.Subscriber(
            words["subscribe"], String, lambda message: received.append(int(message.data.split()[1]))
        )
    print(json.dumps({"event": "ready"}), flush=True)
    sent = 0
    rate = rospy.Rate(HERTZ)
    publisher = rospy.Publisher(words["publish"], String, queue_size=100) if "publish" in words else None
    for _ in range(round(seconds * HERTZ)):
        if publisher is not None:
            sent += 1
            publisher.publish(f"number {sent}")
        rate.sleep()
    threading.Event().wait(LINGER)
    lost = received[-1] - received[0] + 1 - len(received) if received else 0
    print(json.dumps({"event": "counted", "sent": sent, "received": len(received), "lost": lost}), flush=True)


if __name__ == "__main__":
    main()
