"""Carry out orders about parameters from standard input, one JSON object per line.

    {"do": "set", "key": K, "value": V}
    {"do": "get" | "has" | "delete" | "search", "key": K}
    {"do": "names"}
    {"do": "watch", "key": K}    # cached: the node subscribes to it

The events are `done` (with `value`) and `failed`.
"""

import json
import sys

import rospy
from report import init_node, report
from rospy.impl.paramserver import get_param_server_cache

DO = {
    "set": lambda told: rospy.set_param(told["key"], told["value"]),
    "get": lambda told: rospy.get_param(told["key"]),
    "has": lambda told: rospy.has_param(told["key"]),
    "delete": lambda told: rospy.delete_param(told["key"]),
    "search": lambda told: rospy.search_param(told["key"]),
    "names": lambda _: rospy.get_param_names(),
    "watch": lambda told: rospy.get_param_cached(told["key"]),
}


def main():
    init_node("parameters")
    report("ready", name=rospy.get_name(), uri=rospy.get_node_uri())
    watched = get_param_server_cache()
    watched.set_notifier(lambda key, value: report("changed", key=key, value=value))
    for line in sys.stdin:
        told = json.loads(line)
        try:
            report("done", do=told["do"], key=told.get("key"), value=DO[told["do"]](told))
        except (rospy.ROSException, KeyError) as error:
            report("failed", do=told["do"], key=told.get("key"), reason=str(error))
    report("ended")


if __name__ == "__main__":
    main()
