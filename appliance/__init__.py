"""The ROSRV appliance: a network-security appliance for ROS 1 robots.

`docs/dev/architecture.md` starts with a picture of the folders, who calls whom, and the way of a request.
"""

__version__ = "0.2.0"
