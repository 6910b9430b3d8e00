// Tells the test what happens: one JSON object per line on standard output.
#pragma once

#include <ros/ros.h>

#include <cstdio>
#include <mutex>
#include <sstream>
#include <string>

inline std::string json_string(const std::string& text) {
  std::ostringstream out;
  out << '"';
  for (const unsigned char c : text) {
    if (c == '"' || c == '\\') {
      out << '\\' << c;
    } else if (c < 0x20) {
      char escaped[8];
      std::snprintf(escaped, sizeof escaped, "\\u%04x", c);
      out << escaped;
    } else {
      out << c;
    }
  }
  out << '"';
  return out.str();
}

// `fields` is the rest of the object, beginning with a comma, or empty.
inline void report(const std::string& event, const std::string& fields = "") {
  static std::mutex lock;
  const std::lock_guard<std::mutex> held(lock);
  std::printf("{\"event\": %s%s}\n", json_string(event).c_str(), fields.c_str());
  std::fflush(stdout);
}

// The node also logs a line, as nodes do. With its first one roscpp subscribes a parameter, which registers the node; a
// node whose first line is the one that it is being replaced would thereby throw out its successor, with any master.
inline void report_ready() {
  ROS_INFO("started");
  report("ready", ", \"name\": " + json_string(ros::this_node::getName()));
}
