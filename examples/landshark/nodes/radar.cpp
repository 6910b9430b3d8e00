// /landshark_radar, a roscpp node: tells on /landshark/radar how fast the robot moves over ground, twice a second.
// (It simulates that from the velocity the motors are told, as the other sensors simulate theirs from the odometry.)
#include <geometry_msgs/TwistStamped.h>
#include <ros/ros.h>
#include <std_msgs/Float32.h>

#include <cmath>

namespace {
double told = 0;
ros::Time told_at;

void heard(const geometry_msgs::TwistStamped::ConstPtr& command) {
  told = command->twist.linear.x;
  told_at = ros::Time::now();
}
}  // namespace

int main(int argc, char** argv) {
  ros::init(argc, argv, "landshark_radar");
  ros::NodeHandle node;
  ros::Subscriber commands = node.subscribe("/landshark_control/base_velocity", 10, heard);
  ros::Publisher radar = node.advertise<std_msgs::Float32>("/landshark/radar", 10);
  ros::Rate rate(2);
  while (ros::ok()) {
    ros::spinOnce();
    std_msgs::Float32 speed;
    const bool fresh = (ros::Time::now() - told_at).toSec() < 0.5;
    speed.data = fresh ? static_cast<float>(std::fabs(told)) : 0.0F;
    radar.publish(speed);
    rate.sleep();
  }
  return 0;
}
