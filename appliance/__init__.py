"""The ROSRV appliance: a network-security appliance for ROS 1 robots.

`docs/dev/architecture.md` starts with diagrams of the folders, the calls between them, and the path of a request.
"""

__version__ = "0.3.0.dev0"
