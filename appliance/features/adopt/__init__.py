"""Take the graph of a running robot over from its own ROS master, and give it back."""
