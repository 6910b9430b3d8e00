"""Count the messages of `flood_talker.py`: counting_listener.py TOPIC [--slow SECONDS].

The event `first` has the first number. For each line on the input, `counted` has the first and last number, the
number of messages, gaps as pairs of the numbers around them, whether the order was broken, and the texts that
monitors appended, with their first numbers.
"""

import argparse
import sys
import threading

import rospy
from report import init_node, report
from std_msgs.msg import String


class Count:
    def __init__(self, slow):
        self.slow = slow
        self.first = self.last = self.came = 0
        self.backwards = False
        self.never = threading.Event()
        self.gaps = []
        self.words = []

    def heard(self, message):
        parts = message.data.split(" ")
        number, word = int(parts[0]), " ".join(parts[2:])
        if not self.came:
            self.first = number
            report("first", number=number)
        elif number <= self.last:
            self.backwards = True
        elif number != self.last + 1:
            self.gaps.append([self.last, number])
        if not self.words or self.words[-1][0] != word:
            self.words.append([word, number])
        self.last = number
        self.came += 1
        if self.slow:
            self.never.wait(self.slow)

    def tell(self):
        for _line in sys.stdin:
            report(
                "counted",
                first=self.first,
                last=self.last,
                came=self.came,
                gaps=self.gaps,
                backwards=self.backwards,
                words=self.words,
            )


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("topic")
    arguments.add_argument("--slow", type=float, default=0.0)
    options = arguments.parse_args(rospy.myargv()[1:])
    init_node("counting_listener")
    count = Count(options.slow)
    rospy.Subscriber(options.topic, String, count.heard, tcp_nodelay=True)
    threading.Thread(target=count.tell, daemon=True).start()
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    rospy.spin()
    report("ended")


if __name__ == "__main__":
    main()
