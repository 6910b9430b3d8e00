import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[3] / "support" / "rospy_nodes"))

import actionlib
import rospy
from actionlib.msg import TestAction, TestFeedback, TestResult
from report import init_node, report


def main():
    init_node("action_server")

    def work(goal):
        # The client sees its connections before this side has them, so messages sent in between reach no subscriber.
        heard = (server.action_server.feedback_pub, server.action_server.result_pub)
        while not all(topic.get_num_connections() for topic in heard) and not rospy.is_shutdown():
            rospy.sleep(0.01)
        for number in range(goal.goal):
            if server.is_preempt_requested() or rospy.is_shutdown():
                server.set_preempted(TestResult(result=number))
                return
            server.publish_feedback(TestFeedback(feedback=number))
            rospy.sleep(0.02)
        server.set_succeeded(TestResult(result=goal.goal))

    server = actionlib.SimpleActionServer("count", TestAction, work, auto_start=False)
    server.start()
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    rospy.spin()
    report("ended")


if __name__ == "__main__":
    main()
