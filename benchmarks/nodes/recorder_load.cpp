// A robot that talks and one that listens: `talk TOPICS BYTES HERTZ`, `listen TOPICS FILE`.
// FILE gets for each message that was heard its topic, its number and when that was (ns since the epoch), 8 bytes each.
// A message begins with its number on its topic (from 0) and when it was published (CLOCK_MONOTONIC, ns), 8 bytes each.
#include <ros/ros.h>
#include <std_msgs/String.h>
#include <time.h>

#include <algorithm>
#include <cstring>
#include <fstream>
#include <string>
#include <vector>

#include "../../tests/support/roscpp_nodes/report.hpp"

static uint64_t now(clockid_t clock = CLOCK_MONOTONIC) {
  timespec time;
  clock_gettime(clock, &time);
  return uint64_t(time.tv_sec) * 1000000000u + uint64_t(time.tv_nsec);
}

static std::string topic(int number) { return "/load/t" + std::to_string(number); }

// One topic after the other, so that the messages of a period are spread over it.
static void talk(ros::NodeHandle& node, int topics, size_t bytes, double hertz) {
  std::vector<ros::Publisher> publishers;
  for (int number = 0; number < topics; ++number) {
    publishers.push_back(node.advertise<std_msgs::String>(topic(number), 100));
  }
  report_ready();
  const uint64_t pause = uint64_t(1e9 / hertz / topics);
  uint64_t next = now();
  for (uint64_t sent = 0; ros::ok(); ++sent) {
    std_msgs::String message;
    message.data.resize(bytes);
    const uint64_t head[] = {sent / uint64_t(topics), now()};
    std::memcpy(&message.data[0], head, sizeof head);
    publishers[sent % uint64_t(topics)].publish(message);
    next += pause;
    const timespec until = {time_t(next / 1000000000u), long(next % 1000000000u)};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, nullptr);
  }
}

static void listen(ros::NodeHandle& node, int topics, const std::string& file) {
  std::vector<uint64_t> numbers;
  std::vector<uint64_t> delays;
  std::vector<ros::Subscriber> subscribers;
  for (int number = 0; number < topics; ++number) {
    const boost::function<void(const std_msgs::String::ConstPtr&)> heard =
        [&delays, &numbers, number](const std_msgs::String::ConstPtr& message) {
          uint64_t head[2];
          std::memcpy(head, message->data.data(), sizeof head);
          delays.push_back(now() - head[1]);
          numbers.push_back(uint64_t(number));
          numbers.push_back(head[0]);
          numbers.push_back(now(CLOCK_REALTIME));
        };
    subscribers.push_back(node.subscribe<std_msgs::String>(
        topic(number), 100, heard, ros::VoidConstPtr(), ros::TransportHints().tcpNoDelay()));
  }
  report_ready();
  ros::spin();
  std::ofstream(file, std::ios::binary)
      .write(reinterpret_cast<const char*>(numbers.data()), std::streamsize(numbers.size() * sizeof numbers[0]));
  const size_t half = delays.size() / 2;
  if (half) std::nth_element(delays.begin(), delays.begin() + long(half), delays.end());
  report("heard", ", \"messages\": " + std::to_string(delays.size()) +
                      ", \"p50_us\": " + std::to_string(half ? double(delays[half]) / 1e3 : 0.0));
}

int main(int argc, char** argv) {
  const std::vector<std::string> given(argv + 1, argv + argc);
  ros::init(argc, argv, given[0]);
  ros::NodeHandle node;
  if (given[0] == "talk") {
    talk(node, std::stoi(given[1]), std::stoul(given[2]), std::stod(given[3]));
  } else {
    listen(node, std::stoi(given[1]), given[2]);
  }
}
