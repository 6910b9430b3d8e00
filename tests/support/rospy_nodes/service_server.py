"""Offer a std_srvs/SetBool that answers with the negation: service_server.py SERVICE."""

import argparse

import rospy
from report import init_node, report
from std_srvs.srv import SetBool, SetBoolResponse


def answer(request):
    report("called", data=request.data, client=request._connection_header["callerid"])
    return SetBoolResponse(success=not request.data, message="negated")


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("service")
    options = arguments.parse_args(rospy.myargv()[1:])
    init_node("service_server")
    rospy.Service(options.service, SetBool, answer)
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    rospy.spin()
    report("ended")


if __name__ == "__main__":
    main()
