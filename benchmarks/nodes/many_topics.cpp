// A roscpp node that publishes many topics twenty times a second: many_topics N.
#include <ros/ros.h>
#include <std_msgs/String.h>

#include <vector>

#include "../../tests/support/roscpp_nodes/report.hpp"

int main(int argc, char** argv) {
  ros::init(argc, argv, "many_topics");
  ros::NodeHandle node;
  std::vector<ros::Publisher> publishers;
  for (int number = 0; number < std::stoi(argv[1]); ++number) {
    const std::string topic = ros::this_node::getName() + "/t" + std::to_string(number);
    publishers.push_back(node.advertise<std_msgs::String>(topic, 10));
  }
  report_ready();
  ros::Rate rate(20);
  while (ros::ok()) {
    std_msgs::String message;
    message.data = "x";
    for (auto& publisher : publishers) publisher.publish(message);
    ros::spinOnce();
    rate.sleep();
  }
}
