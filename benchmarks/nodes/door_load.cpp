// Publishes texts on /load: `door_load BYTES HERTZ`. A text begins with `t=` and 16 digits: when it was published
// (CLOCK_MONOTONIC, ns). It has no character that an encoding escapes. From 2000 Hz on, texts come many at once, each
// millisecond: a wait for each would take more of the publisher's time than the text.
#include <ros/ros.h>
#include <std_msgs/String.h>
#include <time.h>

#include <algorithm>
#include <cstdio>
#include <cstring>
#include <string>

#include "../../tests/support/roscpp_nodes/report.hpp"

static uint64_t now() {
  timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return uint64_t(time.tv_sec) * 1000000000u + uint64_t(time.tv_nsec);
}

int main(int argc, char** argv) {
  ros::init(argc, argv, "door_load");
  ros::NodeHandle node;
  std_msgs::String message;
  message.data.assign(std::stoul(argv[1]), 'x');
  const double hertz = std::stod(argv[2]);
  const int at_once = std::max(int(hertz / 1000), 1);
  const uint64_t pause = uint64_t(1e9 * at_once / hertz);
  ros::Publisher publisher = node.advertise<std_msgs::String>("/load", 100);
  report_ready();
  for (uint64_t next = now(); ros::ok(); next += pause) {
    for (int number = 0; number < at_once; ++number) {
      char head[20];
      std::snprintf(head, sizeof head, "t=%016llx", static_cast<unsigned long long>(now()));
      std::memcpy(&message.data[0], head, 18);
      publisher.publish(message);
    }
    const timespec until = {time_t(next / 1000000000u), long(next % 1000000000u)};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, nullptr);
  }
}
