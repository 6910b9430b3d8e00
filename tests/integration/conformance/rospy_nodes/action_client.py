import sys
import threading
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[3] / "support" / "rospy_nodes"))

import actionlib
import rospy
from actionlib.msg import TestAction, TestGoal
from actionlib_msgs.msg import GoalStatus
from report import init_node, report


def main():
    init_node("action_client")
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    client = actionlib.SimpleActionClient("count", TestAction)
    client.wait_for_server()
    feedback = []
    client.send_goal_and_wait(TestGoal(goal=5))
    report("reached", result=client.get_result().result, state=client.get_state())
    begun = threading.Event()
    client.send_goal(
        TestGoal(goal=100000), feedback_cb=lambda given: (feedback.append(given.feedback), begun.set())
    )
    # Feedback may overtake the status. If a client cancels before it knows that its goal is accepted, an older status
    # without the goal makes actionlib's client report LOST. If the status is very fast, active_cb is not called.
    while client.get_state() != GoalStatus.ACTIVE and not rospy.is_shutdown():
        rospy.sleep(0.01)
    begun.wait(30)
    client.cancel_goal()
    client.wait_for_result()
    report("cancelled", state=client.get_state(), feedback=len(feedback))


if __name__ == "__main__":
    main()
