// A roscpp subscriber of std_msgs/String: listener TOPIC.
#include <ros/ros.h>
#include <std_msgs/String.h>

#include "report.hpp"

void heard(const ros::MessageEvent<std_msgs::String const>& event) {
  report("received", ", \"data\": " + json_string(event.getMessage()->data) +
                         ", \"publisher\": " + json_string(event.getPublisherName()));
}

int main(int argc, char** argv) {
  ros::init(argc, argv, "listener");
  if (argc < 2) return 2;
  ros::NodeHandle node;
  ros::Subscriber subscriber = node.subscribe(argv[1], 0, heard);  // 0: it loses nothing itself
  report_ready();
  ros::spin();
  report("ended");
  return 0;
}
