// A roscpp node of a robot that starts: launched_node NUMBER NODES PORT.
// It reads 20 private parameters, publishes five topics and subscribes to five of the next node. When all five have
// brought a message, it sends its number and the time (CLOCK_MONOTONIC) to a UDP port.
#include <arpa/inet.h>
#include <ros/ros.h>
#include <std_msgs/String.h>
#include <sys/socket.h>
#include <time.h>

#include <cstdio>
#include <set>
#include <string>
#include <vector>

const int kTopics = 5, kParameters = 20;

void report(int number, int port) {
  timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  char text[64];
  const int length = snprintf(text, sizeof text, "%d %.6f", number, now.tv_sec + now.tv_nsec / 1e9);
  sockaddr_in there{};
  there.sin_family = AF_INET;
  there.sin_port = htons(port);
  there.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  const int sock = socket(AF_INET, SOCK_DGRAM, 0);
  sendto(sock, text, length, 0, reinterpret_cast<sockaddr*>(&there), sizeof there);
}

int main(int argc, char** argv) {
  ros::init(argc, argv, "launched_node");
  const int number = std::stoi(argv[1]), nodes = std::stoi(argv[2]), port = std::stoi(argv[3]);
  ros::NodeHandle node, own("~");
  for (int one = 0; one < kParameters; ++one) {
    double value;
    if (!own.getParam("gain_" + std::to_string(one), value)) return 1;
  }
  const std::string mine = "/launched/" + std::to_string(number) + "/t";
  const std::string theirs = "/launched/" + std::to_string((number + 1) % nodes) + "/t";
  std::vector<ros::Publisher> publishers;
  std::vector<ros::Subscriber> subscribers;
  std::set<int> seen;
  bool reported = false;
  for (int one = 0; one < kTopics; ++one)
    publishers.push_back(node.advertise<std_msgs::String>(mine + std::to_string(one), 1));
  for (int one = 0; one < kTopics; ++one)
    subscribers.push_back(node.subscribe<std_msgs::String>(
        theirs + std::to_string(one), 1, [&seen, one](const std_msgs::String::ConstPtr&) { seen.insert(one); }));
  ros::WallRate rate(20);
  std_msgs::String message;
  message.data = "x";
  while (ros::ok()) {
    for (auto& publisher : publishers) publisher.publish(message);
    ros::spinOnce();
    if (!reported && seen.size() == kTopics) {
      report(number, port);
      reported = true;
    }
    rate.sleep();
  }
}
