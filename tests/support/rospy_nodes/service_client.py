"""Call std_srvs/SetBool: service_client.py SERVICE [--persistent] [--trigger].

Each line `true` or `false` on standard input is one call; with --trigger any line is a call of a std_srvs/Trigger.
"""

import argparse
import sys

import rosgraph
import rospy
from report import init_node, report
from std_srvs.srv import SetBool, Trigger


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("service")
    arguments.add_argument("--persistent", action="store_true")
    arguments.add_argument("--trigger", action="store_true")
    options = arguments.parse_args(rospy.myargv()[1:])
    init_node("service_client")
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    kind = Trigger if options.trigger else SetBool
    call = rospy.ServiceProxy(options.service, kind, persistent=options.persistent)
    for line in sys.stdin:
        try:
            answer = call() if options.trigger else call(line.strip() == "true")
            report("answered", success=answer.success, message=answer.message)
        except (rospy.ServiceException, rospy.ROSException, rosgraph.MasterException) as error:
            report("failed", reason=str(error))
    report("ended")


if __name__ == "__main__":
    main()
