// A roscpp publisher of std_msgs/String: talker TOPIC [--latch] [--text T] [--rate HZ] [--count N] [--handles N].
// Each of the handles publishes, as each nodelet of a manager does.
#include <ros/ros.h>
#include <std_msgs/String.h>

#include <climits>
#include <cstring>
#include <vector>

#include "report.hpp"

int main(int argc, char** argv) {
  ros::init(argc, argv, "talker");
  bool latch = false;
  std::string text = "hello";
  double hertz = 10;
  int count = INT_MAX, handles = 1;
  for (int i = 2; i < argc; ++i) {
    if (!std::strcmp(argv[i], "--latch")) latch = true;
    if (!std::strcmp(argv[i], "--text") && i + 1 < argc) text = argv[++i];
    if (!std::strcmp(argv[i], "--rate") && i + 1 < argc) hertz = std::stod(argv[++i]);
    if (!std::strcmp(argv[i], "--count") && i + 1 < argc) count = std::stoi(argv[++i]);
    if (!std::strcmp(argv[i], "--handles") && i + 1 < argc) handles = std::stoi(argv[++i]);
  }
  ros::NodeHandle node;
  const auto joined = [](const ros::SingleSubscriberPublisher& peer) {
    report("connected", ", \"topic\": " + json_string(peer.getTopic()));
  };
  const auto left = [](const ros::SingleSubscriberPublisher& peer) {
    report("disconnected", ", \"topic\": " + json_string(peer.getTopic()));
  };
  std::vector<ros::Publisher> publishers;
  for (int i = 0; i < handles; ++i)  // 0: it loses nothing itself
    publishers.push_back(node.advertise<std_msgs::String>(argv[1], 0, joined, left, ros::VoidConstPtr(), latch));
  report_ready();
  ros::Rate rate(hertz);
  int number = 0;
  while (ros::ok()) {
    for (auto& publisher : publishers) {
      if (number >= (latch ? handles : count)) break;
      std_msgs::String message;
      message.data = text + " " + std::to_string(++number);
      publisher.publish(message);
      report("sent", ", \"number\": " + std::to_string(number));
    }
    ros::spinOnce();
    rate.sleep();
  }
  report("ended");
  return 0;
}
