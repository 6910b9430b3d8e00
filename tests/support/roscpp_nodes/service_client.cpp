// A roscpp client of std_srvs/SetBool: service_client SERVICE [--persistent].
// Each line `true` or `false` on standard input is one call.
#include <ros/ros.h>
#include <std_srvs/SetBool.h>

#include <cstring>
#include <iostream>

#include "report.hpp"

int main(int argc, char** argv) {
  ros::init(argc, argv, "service_client");
  if (argc < 2) return 2;
  const bool persistent = argc > 2 && !std::strcmp(argv[2], "--persistent");
  ros::NodeHandle node;
  ros::AsyncSpinner spinner(1);
  spinner.start();
  ros::ServiceClient client = node.serviceClient<std_srvs::SetBool>(argv[1], persistent);
  report_ready();
  std::string line;
  while (ros::ok() && std::getline(std::cin, line)) {
    std_srvs::SetBool call;
    call.request.data = line == "true";
    if (client.call(call)) {
      report("answered", std::string(", \"success\": ") + (call.response.success ? "true" : "false") +
                             ", \"message\": " + json_string(call.response.message));
    } else {
      report("failed", ", \"reason\": \"the call failed\"");
    }
  }
  report("ended");
  return 0;
}
