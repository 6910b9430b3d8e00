"""Action servers and clients work, behind a plain master and behind the appliance."""

from tests.support.nodes import RosSession


def test_action(ros: RosSession) -> None:
    """An action server takes a goal, gives feedback in order, and its result arrives: five topics both ways."""
    server = ros.node("rospy", "action", "server", name="counter")
    client = ros.node("rospy", "action", "client", name="asker")
    assert client.wait_for(event="result") == {"event": "result", "result": 3, "state": 3}
    assert [event["number"] for event in client.seen(event="feedback")] == [1, 2, 3]
    assert len(server.wait_for_count(1, event="executed")) == 1
