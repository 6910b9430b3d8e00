"""Both ends of an action: action.py server|client; events `executed`, `feedback`, `result`."""

import sys

import actionlib
import rospy
from actionlib.msg import TestAction, TestFeedback, TestGoal, TestResult
from report import init_node, report

GOAL = 3


def serve():
    """Count up to each goal."""

    def execute(goal):
        for number in range(1, goal.goal + 1):
            rospy.sleep(0.2)  # the work; the client must know its goal, and feedback overtakes no result
            server.publish_feedback(TestFeedback(feedback=number))
        rospy.sleep(0.2)
        report("executed", goal=goal.goal)
        server.set_succeeded(TestResult(result=goal.goal))

    server = actionlib.SimpleActionServer("/count", TestAction, execute, auto_start=False)
    server.start()
    report("ready", name=rospy.get_name())
    rospy.spin()


def ask():
    """Send one goal and wait for its result."""
    client = actionlib.SimpleActionClient("/count", TestAction)
    report("ready", name=rospy.get_name())
    client.wait_for_server()
    client.send_goal(TestGoal(goal=GOAL), feedback_cb=lambda got: report("feedback", number=got.feedback))
    client.wait_for_result()
    report("result", result=client.get_result().result, state=client.get_state())
    rospy.spin()


def main():
    """Be one end."""
    end = rospy.myargv()[1]
    init_node(f"action_{end}")
    {"server": serve, "client": ask}[end]()


if __name__ == "__main__":
    sys.exit(main())
