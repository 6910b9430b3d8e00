// A roscpp node that publishes and subscribes the same topic of std_msgs/String: loop TOPIC.
#include <ros/ros.h>
#include <std_msgs/String.h>

#include "../../../support/roscpp_nodes/report.hpp"

void heard(const ros::MessageEvent<std_msgs::String const>& event) {
  report("received", ", \"data\": " + json_string(event.getMessage()->data) +
                         ", \"publisher\": " + json_string(event.getPublisherName()));
}

int main(int argc, char** argv) {
  ros::init(argc, argv, "loop");
  if (argc < 2) return 2;
  ros::NodeHandle node;
  ros::Subscriber subscriber = node.subscribe(argv[1], 100, heard);
  ros::Publisher publisher = node.advertise<std_msgs::String>(argv[1], 100);
  report_ready();
  ros::Rate rate(20);
  for (int number = 1; ros::ok(); ++number) {
    std_msgs::String message;
    message.data = "mine " + std::to_string(number);
    publisher.publish(message);
    ros::spinOnce();
    rate.sleep();
  }
  report("ended");
  return 0;
}
