// A roscpp service std_srvs/SetBool that answers with the negation: service_server SERVICE.
#include <ros/ros.h>
#include <std_srvs/SetBool.h>

#include "report.hpp"

bool answer(ros::ServiceEvent<std_srvs::SetBool::Request, std_srvs::SetBool::Response>& event) {
  report("called", std::string(", \"data\": ") + (event.getRequest().data ? "true" : "false") +
                       ", \"client\": " + json_string(event.getCallerName()));
  event.getResponse().success = !event.getRequest().data;
  event.getResponse().message = "negated";
  return true;
}

int main(int argc, char** argv) {
  ros::init(argc, argv, "service_server");
  if (argc < 2) return 2;
  ros::NodeHandle node;
  ros::AdvertiseServiceOptions options;
  options.initBySpecType<ros::ServiceEvent<std_srvs::SetBool::Request, std_srvs::SetBool::Response>>(
      node.resolveName(argv[1]), answer);
  ros::ServiceServer server = node.advertiseService(options);
  report_ready();
  ros::spin();
  report("ended");
  return 0;
}
