"""Run one end of dynamic_reconfigure: reconfigure.py server | client SERVER [--rate HZ].

The client changes a number at a rate, and tries once more after a failure. Each line on standard input is answered
with the numbers, in the event `counted`: changes at the first try, at the second, and failed ones.
"""

import argparse
import sys
import threading

import rosgraph
import rospy
from dynamic_reconfigure import DynamicReconfigureCallbackException
from dynamic_reconfigure.cfg import TestConfig
from dynamic_reconfigure.client import Client
from dynamic_reconfigure.server import Server
from report import init_node, report

FAILURES = (DynamicReconfigureCallbackException, rospy.ROSException, rosgraph.MasterException, OSError)


def serve():
    Server(TestConfig, lambda config, _level: config)
    report("ready", name=rospy.get_name())
    rospy.spin()


def change(client, number):
    try:
        return client.update_configuration({"int_": number})["int_"] == number
    except FAILURES as error:
        report("failed", reason=f"{type(error).__name__}: {error}")
        return False


def ask(server, hertz):
    counts = {"first": 0, "second": 0, "failed": 0}

    def answer():
        for _line in sys.stdin:
            report("counted", **counts)

    client = Client(server, timeout=20, config_callback=lambda config: report("told", number=config["int_"]))
    threading.Thread(target=answer, daemon=True).start()
    report("ready", name=rospy.get_name())
    rate, number = rospy.Rate(hertz), 0
    while not rospy.is_shutdown():
        number = number % 9 + 1
        if change(client, number):
            counts["first"] += 1
        else:
            counts["second" if change(client, number) else "failed"] += 1
        try:
            rate.sleep()
        except rospy.ROSInterruptException:
            break


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("end", choices=["server", "client"])
    arguments.add_argument("server", nargs="?")
    arguments.add_argument("--rate", type=float, default=5)
    options = arguments.parse_args(rospy.myargv()[1:])
    init_node(f"reconfigure_{options.end}")
    if options.end == "server":
        serve()
    else:
        ask(options.server, options.rate)


if __name__ == "__main__":
    main()
