// One end of a bond: bonded TOPIC ID. The events are `formed` and `broken`.
#include <bondcpp/bond.h>
#include <ros/ros.h>

#include "report.hpp"

int main(int argc, char** argv) {
  ros::init(argc, argv, "bonded");
  if (argc < 3) return 2;
  ros::NodeHandle node;
  bond::Bond bond(argv[1], argv[2], [] { report("broken"); }, [] { report("formed"); });
  bond.setConnectTimeout(120.0);  // the other end may start slowly
  bond.start();
  report_ready();
  ros::spin();
  return 0;
}
