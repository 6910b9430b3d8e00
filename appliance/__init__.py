"""The ROSRV appliance: a network-security appliance for ROS 1 robots."""

__version__ = "0.4.1"
