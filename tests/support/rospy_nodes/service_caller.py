"""Call a std_srvs/SetBool at a rate: service_caller.py SERVICE [--persistent] [--rate HZ].

A persistent client that failed is made again, as a robust node does. Each failure is the event `failed`. The numbers
are the event `counted`, after each line on standard input.
"""

import argparse
import sys
import threading

import rosgraph
import rospy
from report import init_node, report
from std_srvs.srv import SetBool

# rospy passes on the first failure to write into a kept connection as it is.
FAILURES = (
    rospy.ServiceException,
    rospy.ROSException,
    rospy.exceptions.TransportException,
    rosgraph.MasterException,
)


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("service")
    arguments.add_argument("--persistent", action="store_true")
    arguments.add_argument("--rate", type=float, default=20)
    options = arguments.parse_args(rospy.myargv()[1:])
    init_node("service_caller")
    good, bad = [0], [0]

    def answer():
        for _line in sys.stdin:
            report("counted", good=good[0], bad=bad[0])

    threading.Thread(target=answer, daemon=True).start()
    call = rospy.ServiceProxy(options.service, SetBool, persistent=options.persistent)
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    rate = rospy.Rate(options.rate)
    while not rospy.is_shutdown():
        try:
            call(True)
            good[0] += 1
        except FAILURES as error:
            bad[0] += 1
            report("failed", reason=f"{type(error).__name__}: {error}")
            call.close()
            call = rospy.ServiceProxy(options.service, SetBool, persistent=options.persistent)
        try:
            rate.sleep()
        except rospy.ROSInterruptException:
            break
    report("ended")


if __name__ == "__main__":
    main()
