"""Carry out orders about topics from standard input, one JSON object per line.

    {"do": "subscribe" | "unsubscribe" | "advertise" | "unadvertise" | "publish" | "abandoned",
     "topic": T, "text": X, "latch": B}
    {"do": "now"}                 # the node's time
    {"do": "log", "text": X}      # to rosout

The events are `done`, `received` and `connected`.
"""

import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[3] / "support" / "rospy_nodes"))

import rospy
from report import init_node, report
from std_msgs.msg import String


class Orders:
    def __init__(self):
        self.subscribers, self.publishers = {}, {}

    def subscribe(self, told):
        def heard(message):
            report(
                "received",
                topic=told["topic"],
                data=message.data,
                publisher=message._connection_header["callerid"],
            )

        self.subscribers[told["topic"]] = rospy.Subscriber(told["topic"], String, heard)

    def unsubscribe(self, told):
        self.subscribers.pop(told["topic"]).unregister()

    def abandoned(self, told):
        """Wait until the old connection is gone; otherwise rospy would mistake a new publisher for the old one."""
        subscriber = self.subscribers[told["topic"]]
        for _ in range(3000):
            if not subscriber.get_num_connections():
                return
            rospy.sleep(0.01)
        raise RuntimeError("still connected")

    def advertise(self, told):
        self.publishers[told["topic"]] = rospy.Publisher(
            told["topic"], String, queue_size=100, latch=told.get("latch", False)
        )

    def unadvertise(self, told):
        self.publishers.pop(told["topic"]).unregister()

    def publish(self, told):
        self.publishers[told["topic"]].publish(told["text"])

    def log(self, told):
        rospy.logwarn(told["text"])


def main():
    init_node("orders")
    orders = Orders()
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    for line in sys.stdin:
        told = json.loads(line)
        if told["do"] == "now":
            report("done", do="now", seconds=rospy.Time.now().to_sec())
            continue
        getattr(orders, told["do"])(told)
        report("done", do=told["do"], topic=told.get("topic"))
    report("ended")


if __name__ == "__main__":
    main()
