"""Publish given messages at a rate, and subscribe to topics: frame_talker.py [TOPIC...].

The first line on the input is a list of streams: {"topic", "kind", "md5sum", "text", "hertz", "frames"}, with the
messages, in turn, in hexadecimal. Each further line is an order: {"do": "pause"}, after which the event `paused` has
the number of messages sent on each topic, {"do": "resume"}, or {"do": "say", "hex": H}, which sends these bytes once
on each topic and does not count them.
"""

import json
import sys
import threading
import time

import rospy
from report import init_node, report


class Stream:
    def __init__(self, given):
        fields = {
            "_type": given["kind"],
            "_md5sum": given["md5sum"],
            "_full_text": given["text"],
            "_has_header": False,
            "__slots__": ["data"],
        }
        fields["serialize"] = lambda message, buffer: buffer.write(message.data)
        self.message = type("Frame", (rospy.Message,), fields)
        self.topic, self.period = given["topic"], 1 / given["hertz"]
        self.frames = [bytes.fromhex(frame) for frame in given["frames"]]
        self.publisher = rospy.Publisher(self.topic, self.message, queue_size=100, tcp_nodelay=True)
        self.sent, self.due = 0, time.monotonic()

    def say(self, data):
        message = self.message()
        message.data = data
        self.publisher.publish(message)

    def publish(self):
        self.say(self.frames[self.sent % len(self.frames)])
        self.sent += 1
        self.due = max(self.due + self.period, time.monotonic())


def publish(streams, turn, playing):
    while streams and not rospy.is_shutdown():
        playing.wait()
        stream = min(streams, key=lambda one: one.due)
        threading.Event().wait(max(0, stream.due - time.monotonic()))
        with turn:
            if playing.is_set():
                stream.publish()


def main():
    init_node("frame_talker")
    for topic in rospy.myargv()[1:]:
        rospy.Subscriber(topic, rospy.AnyMsg)
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    streams = [Stream(given) for given in json.loads(sys.stdin.readline())]
    turn, playing = threading.Lock(), threading.Event()
    playing.set()
    threading.Thread(target=publish, args=(streams, turn, playing), daemon=True).start()
    for line in sys.stdin:
        order = json.loads(line)
        with turn:
            if order["do"] == "pause":
                playing.clear()
                report("paused", sent={stream.topic: stream.sent for stream in streams})
            elif order["do"] == "resume":
                playing.set()
            else:
                for stream in streams:
                    stream.say(bytes.fromhex(order["hex"]))
    rospy.spin()


if __name__ == "__main__":
    main()
