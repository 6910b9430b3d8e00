"""Publish and hear own/Drive, in which one wheel is an array: drive.py TOPIC left|right.

Both definitions have the same md5sum. `right` has an array of right wheels, so that one left wheel comes first.
"""

import rospy
from genpy.dynamic import generate_dynamic
from report import init_node, report

RULE = "=" * 80


def main():
    topic, array = rospy.myargv()[1:]
    fields = "\n".join(f"Wheel{'[]' if wheel == array else ''} {wheel}" for wheel in ("left", "right"))
    kinds = generate_dynamic("own/Drive", f"{fields}\n{RULE}\nMSG: own/Wheel\nint8 speed")
    kind, wheel = kinds["own/Drive"], kinds["own/Wheel"]
    init_node("drive")

    def hear(message):
        if message._connection_header["callerid"] != rospy.get_name():
            wheels = {one: getattr(message, one) for one in ("left", "right")}
            speeds = {
                one: [part.speed for part in value] if one == array else value.speed
                for one, value in wheels.items()
            }
            report("received", **speeds)

    rospy.Subscriber(topic, kind, hear)
    publisher = rospy.Publisher(topic, kind, queue_size=10)
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    rate, number = rospy.Rate(10), 0
    while not rospy.is_shutdown():
        number = number % 100 + 1
        single = "right" if array == "left" else "left"
        publisher.publish(**{array: [], single: wheel(number)})
        try:
            rate.sleep()
        except rospy.ROSInterruptException:
            break


if __name__ == "__main__":
    main()
