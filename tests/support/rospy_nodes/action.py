"""Run one end of an action: action.py server|client. The events are `executed`, `feedback` and `result`."""

import sys

import actionlib
import rospy
from actionlib.msg import TestAction, TestFeedback, TestGoal, TestResult
from report import init_node, report

GOAL = 3
HEARD = "/feedback_heard"  # the client's last feedback; 0 once it knows its goal


def serve():
    """Serve in step with the client: actionlib drops feedback that comes before the goal or after the result."""

    def until(reached):
        while not reached() and not rospy.is_shutdown():
            rospy.sleep(0.02)

    def execute(goal):
        until(server.action_server.feedback_pub.get_num_connections)
        until(server.action_server.result_pub.get_num_connections)
        until(lambda: rospy.get_param(HEARD, None) == 0)
        for number in range(1, goal.goal + 1):
            server.publish_feedback(TestFeedback(feedback=number))
            until(lambda number=number: rospy.get_param(HEARD, None) == number)
        report("executed", goal=goal.goal)
        server.set_succeeded(TestResult(result=goal.goal))

    server = actionlib.SimpleActionServer("/count", TestAction, execute, auto_start=False)
    server.start()
    report("ready", name=rospy.get_name())
    rospy.spin()


def ask():
    client = actionlib.SimpleActionClient("/count", TestAction)
    report("ready", name=rospy.get_name())
    client.wait_for_server()

    def heard(got):
        report("feedback", number=got.feedback)
        rospy.set_param(HEARD, got.feedback)

    client.send_goal(TestGoal(goal=GOAL), feedback_cb=heard)
    rospy.set_param(HEARD, 0)
    client.wait_for_result()
    rospy.delete_param(HEARD)
    report("result", result=client.get_result().result, state=client.get_state())
    rospy.spin()


def main():
    end = rospy.myargv()[1]
    init_node(f"action_{end}")
    {"server": serve, "client": ask}[end]()


if __name__ == "__main__":
    sys.exit(main())
