"""A rospy client of std_srvs/SetBool: service_client.py SERVICE [--persistent].

Each line `true` or `false` on standard input is one call.
"""

import argparse
import sys

import rospy
from report import report
from std_srvs.srv import SetBool


def main():
    """Call for each line of the input."""
    arguments = argparse.ArgumentParser()
    arguments.add_argument("service")
    arguments.add_argument("--persistent", action="store_true")
    options = arguments.parse_args(rospy.myargv()[1:])
    rospy.init_node("service_client")
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    call = rospy.ServiceProxy(options.service, SetBool, persistent=options.persistent)
    for line in sys.stdin:
        try:
            answer = call(line.strip() == "true")
            report("answered", success=answer.success, message=answer.message)
        except (rospy.ServiceException, rospy.ROSException) as error:
            report("failed", reason=str(error))
    report("ended")


if __name__ == "__main__":
    main()
