"""Publish how many viewers each door has: `/rosrv/viewers/NAME`, a latched `std_msgs/UInt32`.

[Subscribers] of the policy decides who may read it, as with any topic. A `-` of the door's name is `_` there.
"""

import struct
from collections.abc import Iterable

from appliance.channel.messages import OwnHeaderStated, OwnPublished
from appliance.control.core import RelayOrders

UINT32 = ("std_msgs/UInt32", "304a39449588c7f8ce2df6e8001c5fce", "uint32 data\n")
"""The type of the topics, its md5sum and its definition."""


class ViewerTopics:
    """The topics of all doors, with the counts that they told last."""

    def __init__(self, relay: RelayOrders, node: str) -> None:
        self._relay = relay
        self._node = node
        self._counts: dict[str, int] = {}  # as published, by door

    def tell(self, counts: Iterable[tuple[str, int]]) -> None:
        """Publish the counts that changed, by the name of the door, and end the topics of all other doors."""
        now = dict(counts)
        if now.keys() != self._counts.keys():
            headers = [OwnHeaderStated(self._topic(name), *UINT32, latching=True) for name in now]
            self._relay.publish_only("doors", headers)
        before, self._counts = self._counts, now
        for name, count in now.items():
            if before.get(name) != count:
                self._relay.publish(OwnPublished(self._topic(name), struct.pack("<I", count)))

    def _topic(self, name: str) -> str:
        return f"{self._node}/viewers/{name.replace('-', '_')}"
