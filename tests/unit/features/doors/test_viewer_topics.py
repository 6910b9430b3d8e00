"""A door's number of viewers is a latched topic, and each feature keeps its own topics of the appliance's node."""

import struct
from typing import Any, cast

from appliance.channel.messages import OwnHeaderStated, OwnPublished
from appliance.control.core import RelayOrders
from appliance.features.doors.viewer_topics import ViewerTopics


class Relay:
    """The relay's part of own topics."""

    def __init__(self) -> None:
        self.topics: dict[str, OwnHeaderStated] = {}
        self.told: list[tuple[str, int]] = []
        self.ranks = None
        self.carried_out = None
        self.taps = cast("Any", type("Taps", (), {"look": None, "stop": None, "stoppers": None}))

    def begin_own_topic(self, header: OwnHeaderStated) -> None:
        self.topics[header.topic] = header

    def end_own_topic(self, topic: str) -> None:
        del self.topics[topic]

    def publish(self, message: OwnPublished) -> None:
        assert message.topic in self.topics
        [count] = struct.unpack("<I", message.data)
        self.told.append((message.topic, count))


def test_a_change_of_the_number_is_published() -> None:
    relay, changes = Relay(), list[int]()
    orders = RelayOrders(cast("Any", relay), cast("Any", None), lambda: changes.append(1))
    orders.publish_only("authority", [OwnHeaderStated("/rosrv/driver/base", "", "", "", latching=True)])
    topics = ViewerTopics(orders, "/rosrv")
    topics.tell([("alice", 0), ("agent-1", 2)])
    assert relay.told == [("/rosrv/viewers/alice", 0), ("/rosrv/viewers/agent_1", 2)]
    assert all(header.latching for header in relay.topics.values())
    topics.tell([("alice", 0), ("agent-1", 2)])
    assert len(relay.told) == 2
    topics.tell([("alice", 1)])
    assert relay.told[2:] == [("/rosrv/viewers/alice", 1)]
    assert set(relay.topics) == {"/rosrv/driver/base", "/rosrv/viewers/alice"}
    topics.tell([])
    topics.tell([("alice", 0)])
    assert relay.told[3:] == [("/rosrv/viewers/alice", 0)], "a door that was added again begins at 0"
    orders.publish_only("authority", ())
    assert set(relay.topics) == {"/rosrv/viewers/alice"}
    assert len(changes) == 6
