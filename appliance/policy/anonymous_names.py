"""Replace the numbers of anonymous node names by a star. No I/O."""

import re

# The suffixes of rospy (process id and milliseconds) and of roscpp (nanoseconds).
_ANONYMOUS = re.compile(r"_[0-9]++_[0-9]{10,}+$|_[0-9]{15,}+$")


def key_of(name: str) -> str:
    """Return the key of a name: `/rostopic_*` for `/rostopic_4711_1700000000000`."""
    return "/".join(_ANONYMOUS.sub("_*", level) for level in name.split("/"))
