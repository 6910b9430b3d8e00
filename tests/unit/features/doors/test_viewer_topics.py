"""A door's number of viewers is a latched topic, and each feature keeps its own topics of the appliance's node."""

import struct

import pytest

from appliance.channel.messages import OwnHeaderStated, OwnPublished
from appliance.control.assembly.services import CallHolder
from appliance.control.core import RelayOrders
from appliance.features.doors.orders import ViewerTopics
from tests.support.control_parts import ControlParts


@pytest.mark.anyio
async def test_a_change_of_the_number_is_published() -> None:
    parts, changes = ControlParts(), list[int]()
    relay = parts.relay

    def told() -> list[tuple[str, int]]:
        messages = [message for message in parts.seen if isinstance(message, OwnPublished)]
        return [(message.topic, *struct.unpack("<I", message.data)) for message in messages]

    orders = RelayOrders(relay, CallHolder(), lambda: changes.append(1))
    orders.publish_only("authority", [OwnHeaderStated("/rosrv/driver/base", "", "", "", latching=True)])
    topics = ViewerTopics(orders, "/rosrv")
    topics.tell([("alice", 0), ("agent-1", 2)])
    assert told() == [("/rosrv/viewers/alice", 0), ("/rosrv/viewers/agent_1", 2)]
    assert all(header.latching for header in relay.own_topics.values())
    topics.tell([("alice", 0), ("agent-1", 2)])
    assert len(told()) == 2
    topics.tell([("alice", 1)])
    assert told()[2:] == [("/rosrv/viewers/alice", 1)]
    assert set(relay.own_topics) == {"/rosrv/driver/base", "/rosrv/viewers/alice"}
    topics.tell([])
    topics.tell([("alice", 0)])
    assert told()[3:] == [("/rosrv/viewers/alice", 0)], "a door that was added again begins at 0"
    orders.publish_only("authority", ())
    assert set(relay.own_topics) == {"/rosrv/viewers/alice"}
    assert len(changes) == 6
