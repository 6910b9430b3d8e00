"""Make the LandShark's own message type from its .msg file at run time, as `catkin_make` would at build time.

The environment variable LANDSHARK_MESSAGES names the folder with `landshark_msgs/PaintballTrigger.msg`. The default
is `monitors/msg` of this checkout.
"""

import os
from pathlib import Path

import genpy.dynamic
from std_msgs.msg import Header

DEFAULT_FOLDER = Path(__file__).resolve().parents[3] / "monitors" / "msg"


def paintball_trigger():
    folder = Path(os.environ.get("LANDSHARK_MESSAGES", DEFAULT_FOLDER))
    text = (folder / "landshark_msgs" / "PaintballTrigger.msg").read_text()
    divider = "=" * 80
    full = f"{text}\n{divider}\nMSG: std_msgs/Header\n{Header._full_text}\n"
    return genpy.dynamic.generate_dynamic("landshark_msgs/PaintballTrigger", full)[
        "landshark_msgs/PaintballTrigger"
    ]
