// Serves goals that take time, or asks for them, as rospy_nodes/goals.py: goals server|client ACTION [--long].
#include <actionlib/TestAction.h>
#include <actionlib/client/simple_action_client.h>
#include <actionlib/server/simple_action_server.h>
#include <ros/ros.h>

#include <atomic>
#include <iostream>
#include <thread>

#include "report.hpp"

namespace {
constexpr int short_goal = 5, long_goal = 1000000;
constexpr double step_seconds = 0.05, result_seconds = 5.0;
using Server = actionlib::SimpleActionServer<actionlib::TestAction>;
using Client = actionlib::SimpleActionClient<actionlib::TestAction>;

void serve(const std::string& action) {
  ros::NodeHandle node;
  Server* running = nullptr;
  Server server(
      node, action,
      [&running](const actionlib::TestGoalConstPtr& goal) {
        actionlib::TestResult result;
        for (int number = 1; number <= goal->goal && ros::ok(); ++number) {
          if (running->isPreemptRequested()) {
            result.result = number;
            running->setPreempted(result);
            return;
          }
          actionlib::TestFeedback feedback;
          feedback.feedback = number;
          running->publishFeedback(feedback);
          ros::Duration(step_seconds).sleep();
        }
        result.result = goal->goal;
        running->setSucceeded(result);
      },
      false);
  running = &server;
  server.start();
  report_ready();
  ros::spin();
}

void ask_for_long(Client& client) {
  actionlib::TestGoal goal;
  goal.goal = long_goal;
  client.sendGoal(goal, Client::SimpleDoneCallback(), Client::SimpleActiveCallback(),
                  [](const actionlib::TestFeedbackConstPtr& got) {
                    report("feedback", ", \"number\": " + std::to_string(got->feedback));
                  });
  std::string line;
  std::getline(std::cin, line);
  client.cancelGoal();
  const bool came = client.waitForResult(ros::Duration(result_seconds));
  report("result", ", \"result\": " + (came ? std::to_string(client.getResult()->result) : std::string("null")));
}

void ask_for_short(Client& client) {
  static std::atomic<int> good{0}, bad{0};
  std::thread([] {
    for (std::string line; std::getline(std::cin, line);)
      report("counted", ", \"good\": " + std::to_string(good) + ", \"bad\": " + std::to_string(bad));
  }).detach();
  while (ros::ok()) {
    actionlib::TestGoal goal;
    goal.goal = short_goal;
    client.sendGoal(goal);
    if (client.waitForResult(ros::Duration(result_seconds))) {
      ++good;
    } else if (ros::ok()) {
      ++bad;
      report("lost", ", \"state\": " + json_string(client.getState().toString()));
      client.cancelGoal();
    }
  }
}
}  // namespace

int main(int argc, char** argv) {
  if (argc < 3) return 2;
  const std::string end = argv[1], action = argv[2], option = argc > 3 ? argv[3] : "";
  ros::init(argc, argv, "goals_" + end);
  if (end == "server") {
    serve(action);
    return 0;
  }
  ros::NodeHandle node;
  Client client(action, true);
  client.waitForServer();
  report_ready();
  if (option == "--long") {
    ask_for_long(client);
    ros::waitForShutdown();
  } else {
    ask_for_short(client);
  }
  std::_Exit(0);  // a thread may still wait for standard input
}
