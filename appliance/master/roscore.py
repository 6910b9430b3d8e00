"""What `roscore` sets up on a new ROS Master beside the program itself: its parameters."""

import os
import re
import uuid
from pathlib import Path

import structlog

from appliance.ros.parameter_tree import Tree

_PACKAGE = Path("/usr/share/rosmaster/package.xml")

_log = structlog.get_logger()


def own_parameters() -> Tree:
    """What `roscore` sets on a new ROSMaster; a fresh `/run_id` at each call."""
    tree: Tree = {"run_id": str(uuid.uuid1()), "rosdistro": os.environ.get("ROS_DISTRO", "Debian") + "\n"}
    try:
        text = _PACKAGE.read_text(encoding="utf-8")
    except OSError as error:
        _log.warning("the version of ROS is not known: /rosversion is not set", error=str(error))
        return tree
    version = re.search(r"<version>\s*([^<\s]+)", text)
    if version is not None:
        tree["rosversion"] = version[1] + "\n"
    return tree
