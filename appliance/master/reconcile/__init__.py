"""Keep graph, ROS master and the robot's nodes consistent."""
