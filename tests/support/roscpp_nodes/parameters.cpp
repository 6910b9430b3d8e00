// A roscpp node that works with string parameters as told on standard input, one command per line:
// `set KEY VALUE`, `get KEY`, `has KEY`, `delete KEY`, `watch KEY` (cached: the node subscribes to the parameter,
// and reports `changed` when its cache does).
#include <ros/ros.h>

#include <iostream>
#include <map>
#include <sstream>

#include "report.hpp"

namespace {
std::map<std::string, std::string> watched;  // the value last reported; used by the timer's thread only
std::mutex watched_lock;

void look(const ros::TimerEvent&) {
  const std::lock_guard<std::mutex> held(watched_lock);
  for (auto& [key, last] : watched) {
    std::string value;
    if (ros::param::getCached(key, value) && value != last) {
      last = value;
      report("changed", ", \"key\": " + json_string(key) + ", \"value\": " + json_string(value));
    }
  }
}

void obey(const std::string& what, const std::string& key, const std::string& given) {
  bool done = true;
  std::string value = "null";
  if (what == "set") {
    ros::param::set(key, given);
  } else if (what == "get") {
    std::string found;
    done = ros::param::get(key, found);
    value = json_string(found);
  } else if (what == "has") {
    value = ros::param::has(key) ? "true" : "false";
  } else if (what == "delete") {
    done = ros::param::del(key);
  } else if (what == "watch") {
    const std::lock_guard<std::mutex> held(watched_lock);
    std::string found;
    done = ros::param::getCached(key, found);
    watched[key] = found;
    value = json_string(found);
  } else {
    done = false;
  }
  report(done ? "done" : "failed",
         ", \"do\": " + json_string(what) + ", \"key\": " + json_string(key) + ", \"value\": " + value);
}
}  // namespace

int main(int argc, char** argv) {
  ros::init(argc, argv, "parameters");
  ros::NodeHandle node;
  ros::AsyncSpinner spinner(1);
  ros::Timer timer = node.createTimer(ros::Duration(0.05), look);
  spinner.start();
  report_ready();
  std::string line;
  while (ros::ok() && std::getline(std::cin, line)) {
    std::istringstream words(line);
    std::string what, key, given;
    words >> what >> key;
    std::getline(words >> std::ws, given);
    obey(what, key, given);
  }
  report("ended");
  return 0;
}
