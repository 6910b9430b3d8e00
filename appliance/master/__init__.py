"""RVMaster listens where nodes expect the ROS master, decides every request, and forwards granted requests."""
