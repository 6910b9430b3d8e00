// A nodelet that publishes on its topic `out` each std_msgs/String of its topic `in`.
#include <nodelet/nodelet.h>
#include <pluginlib/pluginlib/class_list_macros.hpp>
#include <ros/ros.h>
#include <std_msgs/String.h>

namespace rosrv_nodelets {
class Echo : public nodelet::Nodelet {
  void onInit() override {
    publisher_ = getPrivateNodeHandle().advertise<std_msgs::String>("out", 0);
    subscriber_ = getPrivateNodeHandle().subscribe<std_msgs::String>(
        "in", 0, [this](const std_msgs::String::ConstPtr& message) { publisher_.publish(message); });
  }

  ros::Publisher publisher_;
  ros::Subscriber subscriber_;
};
}  // namespace rosrv_nodelets

PLUGINLIB_EXPORT_CLASS(rosrv_nodelets::Echo, nodelet::Nodelet)
