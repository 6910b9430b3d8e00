"""`rosrv survey`: read the graph of a robot from its ROS master, without registering anything."""
