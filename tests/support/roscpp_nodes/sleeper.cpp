// Sleeps 0.1 s of ROS time again and again: the event `slept` has the ROS time after it, in seconds.
#include <ros/ros.h>

#include "report.hpp"

int main(int argc, char** argv) {
  ros::init(argc, argv, "sleeper");
  ros::NodeHandle node;
  ros::AsyncSpinner spinner(1);
  spinner.start();
  report_ready();
  while (ros::ok()) {
    ros::Duration(0.1).sleep();
    report("slept", ", \"now\": " + std::to_string(ros::Time::now().toSec()));
  }
  return 0;
}
