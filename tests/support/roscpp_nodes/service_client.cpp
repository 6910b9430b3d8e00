// A roscpp client of std_srvs/SetBool: service_client SERVICE [--persistent|--trigger].
// Each line `true` or `false` on standard input is one call; with --trigger of a std_srvs/Trigger, whatever it says.
#include <ros/ros.h>
#include <std_srvs/SetBool.h>
#include <std_srvs/Trigger.h>

#include <iostream>

#include "report.hpp"

static void ask(std_srvs::SetBool& call, const std::string& line) { call.request.data = line == "true"; }
static void ask(std_srvs::Trigger&, const std::string&) {}

template <class Service>
static void call_for_each_line(ros::NodeHandle& node, const char* name, bool persistent) {
  ros::ServiceClient client = node.serviceClient<Service>(name, persistent);
  report_ready();
  std::string line;
  while (ros::ok() && std::getline(std::cin, line)) {
    Service call;
    ask(call, line);
    if (client.call(call)) {
      report("answered", std::string(", \"success\": ") + (call.response.success ? "true" : "false") +
                             ", \"message\": " + json_string(call.response.message));
    } else {
      report("failed", ", \"reason\": \"the call failed\"");
    }
  }
}

int main(int argc, char** argv) {
  ros::init(argc, argv, "service_client");
  if (argc < 2) return 2;
  const std::string option = argc > 2 ? argv[2] : "";
  ros::NodeHandle node;
  ros::AsyncSpinner spinner(1);
  spinner.start();
  if (option == "--trigger") {
    call_for_each_line<std_srvs::Trigger>(node, argv[1], false);
  } else {
    call_for_each_line<std_srvs::SetBool>(node, argv[1], option == "--persistent");
  }
  report("ended");
  return 0;
}
