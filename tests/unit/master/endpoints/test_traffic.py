import pytest

from appliance.audit.log.record import Severity
from appliance.channel.messages import ConnectionRefused
from appliance.master.endpoints.traffic import RelayTraffic
from appliance.master.graph.registry import Kind, Registry
from tests.support.core import FakeTrail
from tests.support.incarnations import incarnation


@pytest.mark.parametrize(
    ("host", "topic", "attack"),
    [("10.0.0.2", "/rosout", False), ("10.0.0.2", "/camera", True), ("10.0.0.66", "/rosout", True)],
)
def test_a_late_connection_of_our_own_node_is_not_an_attack(host: str, topic: str, attack: bool) -> None:
    trail = FakeTrail()
    registry = Registry()
    for key, name, own in (("k", "/talker", False), ("o", "/rosout", True)):
        node = incarnation(name, host="10.0.0.2", key=key, path=f"/{key}", own=own)
        registry.add(node)
        if own:
            registry.register(node, Kind.SUBSCRIPTION, "/rosout", "rosgraph_msgs/Log")
    told = RelayTraffic(trail, registry, 1, lambda _node, _topic: None)
    told.refused(ConnectionRefused("k", "topic", topic, host, "/rosout", "[/talker] is not a publisher", 1))
    (record,) = trail.rows
    assert record["decision"] == ("deny" if attack else None)
    assert record["severity"] is (Severity.WARNING if attack else Severity.INFO)
    assert (record["category"], record["resource"], record["node"]) == ("topic", topic, "/talker")


def test_a_refusal_without_a_name_has_no_category() -> None:
    trail = FakeTrail()
    told = RelayTraffic(trail, Registry(), 1, lambda _node, _topic: None)
    told.refused(ConnectionRefused("k", "", "", "10.0.0.66", "", "said nothing", 2))
    assert (trail.rows[0]["category"], trail.rows[0]["count"]) == (None, 2)
