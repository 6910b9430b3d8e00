"""List the rights that the stock tools of ROS need before they carry out a command. No I/O.

A denied tool reports only its first denied call. The calls are those that the tools of Debian 12 made with all their
verbs that only read.
"""

import re
from dataclasses import dataclass

from appliance.policy.model import Address, Category, Request
from appliance.policy.rights import Right, rights_of

# The suffixes of rospy and `$(anon)` (process id and milliseconds or a random number), roscpp (nanoseconds), and rqt.
_ANONYMOUS = re.compile(
    r"_[0-9]++_[0-9]{10,}+$|_[0-9]{15,}+$|(?<=^rqt_gui_py_node)_[0-9]++$|(?<=^rqt_gui_cpp_node)_[0-9]++$"
)
_LAUNCH_PORT = re.compile(
    r"(?<=^/roslaunch/uris/)[^/]++"
)  # `roslaunch` sets /roslaunch/uris/host_robot__42311
_READ = ("/use_sim_time", "/tcp_keepalive")
_LONGEST = 256  # characters of a tool's own name
_LOG_LEVEL = ("get_loggers", "set_logger_level")


def key_of(name: str) -> str:
    """Return the key for a name of one run: `/rostopic_*` for `/rostopic_4711_1700000000000`."""
    return "/".join(_ANONYMOUS.sub("_*", level) for level in _LAUNCH_PORT.sub("*", name).split("/"))


def name_for(key: str) -> str:
    """Return a name that the key matches, and no key of a name that lasts."""
    return key.replace("*", "1_1000000000")


@dataclass(frozen=True, slots=True)
class StockTool:
    """The calls that a tool makes under its own name; `node`: it also starts an anonymous node."""

    name: str
    calls: tuple[str, ...]
    node: bool = True

    def rights(self, host: Address) -> list[Right]:
        name = f"/{self.name}_1_1000000000"
        asked = [(Category.COMMAND, call) for call in self.calls]
        if self.node:
            asked += [(Category.NODE, name), (Category.PUBLISH, "/rosout")]
            asked += [(Category.OFFER, f"{name}/{service}") for service in _LOG_LEVEL]
            asked += [(Category.READ, key) for key in _READ]
            asked += [(Category.COMMAND, call) for call in ("hasParam", "subscribeParam", "unsubscribeParam")]
        return [right for what, word in asked for right in rights_of(Request(host, name, what, word))]


_TOOLS = (
    StockTool("rostopic", ("getPid", "getSystemState", "getTopicTypes", "getPublishedTopics", "lookupNode")),
    StockTool(
        "rosnode",
        ("getPid", "getSystemState", "getPublishedTopics", "lookupNode", "getBusInfo"),
        node=False,
    ),
    StockTool("rosservice", ("getSystemState", "lookupService")),
    StockTool("rosparam", ("getParam", "getParamNames", "hasParam", "searchParam"), node=False),
    StockTool("record", ("getPublishedTopics",)),
    StockTool("play", ()),
)


def stock_tool(caller_id: str) -> StockTool | None:
    if len(caller_id) > _LONGEST:
        return None
    key = key_of(caller_id)
    own = key.removeprefix("/").removesuffix("_*").partition("-")[0]
    if key == caller_id and not own.startswith("ros"):
        return None  # a node with a usual name, such as /record
    return next((tool for tool in _TOOLS if tool.name == own), None)
