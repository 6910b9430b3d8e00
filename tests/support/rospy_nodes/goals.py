"""Serve goals that take time, or ask for them: goals.py server|client ACTION [--long].

A goal N takes N times 50 ms, with a feedback in each, and its result is the number of steps done. The client asks for
one short goal after the other; a goal without its result after 5 s is lost. With `--long` it asks once, and cancels at
the first line on standard input. Else each line is answered with the numbers, in the event `counted`.
"""

import argparse
import sys
import threading

import actionlib
import rospy
from actionlib.msg import TestAction, TestFeedback, TestGoal, TestResult
from report import init_node, report

SHORT, LONG = 5, 1_000_000
STEP_SECONDS, RESULT_SECONDS = 0.05, 5.0


def serve(action):
    def execute(goal):
        for number in range(1, goal.goal + 1):
            if server.is_preempt_requested():
                server.set_preempted(TestResult(result=number))
                return
            server.publish_feedback(TestFeedback(feedback=number))
            rospy.sleep(STEP_SECONDS)
        server.set_succeeded(TestResult(result=goal.goal))

    server = actionlib.SimpleActionServer(action, TestAction, execute, auto_start=False)
    server.start()
    report("ready", name=rospy.get_name())
    rospy.spin()


def ask_for_long(client):
    client.send_goal(TestGoal(goal=LONG), feedback_cb=lambda got: report("feedback", number=got.feedback))
    sys.stdin.readline()
    client.cancel_goal()
    came = client.wait_for_result(rospy.Duration(RESULT_SECONDS))
    report("result", result=client.get_result().result if came else None, state=client.get_state())


def ask_for_short(client):
    good, bad = [0], [0]

    def answer():
        for _line in sys.stdin:
            report("counted", good=good[0], bad=bad[0])

    threading.Thread(target=answer, daemon=True).start()
    while not rospy.is_shutdown():
        client.send_goal(TestGoal(goal=SHORT))
        if client.wait_for_result(rospy.Duration(RESULT_SECONDS)):
            good[0] += 1
        else:
            bad[0] += 1
            report("lost", state=client.get_state())
            client.cancel_goal()


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("end", choices=["server", "client"])
    arguments.add_argument("action")
    arguments.add_argument("--long", action="store_true")
    options = arguments.parse_args(rospy.myargv()[1:])
    init_node(f"goals_{options.end}")
    if options.end == "server":
        serve(options.action)
        return
    client = actionlib.SimpleActionClient(options.action, TestAction)
    client.wait_for_server()
    report("ready", name=rospy.get_name())
    try:
        (ask_for_long if options.long else ask_for_short)(client)
    except rospy.ROSInterruptException:
        return
    rospy.spin()


if __name__ == "__main__":
    main()
