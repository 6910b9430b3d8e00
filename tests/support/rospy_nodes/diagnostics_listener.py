"""Report each status on `/diagnostics`, as any subscriber reads it: with the definition of the publisher."""

import genpy.dynamic
import rospy
from report import init_node, report

KIND = "diagnostic_msgs/DiagnosticArray"
LATE = 1.0  # seconds


def heard(message):
    header = message._connection_header
    array = genpy.dynamic.generate_dynamic(KIND, header["message_definition"])[KIND]()
    array.deserialize(message._buff)
    late = abs(rospy.get_time() - array.header.stamp.to_sec()) > LATE
    statuses = {
        one.name: {"level": one.level, "message": one.message, "hardware": one.hardware_id}
        for one in array.status
    }
    report("received", publisher=header["callerid"], late=late, statuses=statuses)


def main():
    init_node("diagnostics_listener")
    rospy.Subscriber("/diagnostics", rospy.AnyMsg, heard)
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    rospy.spin()


if __name__ == "__main__":
    main()
