"""Replace the numbers of anonymous node names by a star. No I/O."""

import re

# The suffixes of rospy (process id and milliseconds) and of roscpp (nanoseconds).
_ANONYMOUS = re.compile(r"_[0-9]++_[0-9]{10,}+$|_[0-9]{15,}+$")


def key_of(name: str) -> str:
    """The key of `/rostopic_4711_1700000000000` is `/rostopic_*`."""
    return "/".join(_ANONYMOUS.sub("_*", level) for level in name.split("/"))
