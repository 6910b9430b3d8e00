"""Keep graph, ROS master and the robot's nodes consistent: carry out effects, check nodes, reconcile differences."""
