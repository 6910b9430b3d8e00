"""The ROSRV appliance: a network-security appliance for ROS 1 robots."""

__version__ = "0.5.0.dev0"
