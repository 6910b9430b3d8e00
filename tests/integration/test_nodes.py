import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.nodes import Client, RosSession, numbers, without_gap
from tests.support.site import Site

CLIENTS: list[Client] = ["rospy", "roscpp"]


@pytest.fixture
def ros(site: Site, tmp_path: Path) -> Iterator[RosSession]:
    with RosSession(site.master_uri, tmp_path, site.robot) as session:
        yield session


@pytest.mark.real
@pytest.mark.parametrize("subscriber_first", [True, False], ids=["listener-first", "talker-first"])
@pytest.mark.parametrize("to", CLIENTS)
@pytest.mark.parametrize("by", CLIENTS)
def test_talker_to_listener(ros: RosSession, by: Client, to: Client, subscriber_first: bool) -> None:
    if subscriber_first:
        listener = ros.listener(to, "/chatter")
        ros.talker(by, "/chatter", name="voice")
    else:
        ros.talker(by, "/chatter", name="voice")
        listener = ros.listener(to, "/chatter")
    heard = listener.wait_for_count(5, event="received")
    assert without_gap(numbers(heard))
    assert {event["publisher"] for event in heard} == {"/voice"}


@pytest.mark.parametrize("to", CLIENTS)
@pytest.mark.parametrize("by", CLIENTS)
def test_latched_message(ros: RosSession, by: Client, to: Client) -> None:
    talker = ros.talker(by, "/map", "--latch")
    talker.wait_for(event="sent")
    for number in range(2):
        listener = ros.listener(to, "/map", name=f"late_{number}")
        assert listener.wait_for(event="received")["data"] == "hello 1"
        assert len(listener.seen(event="received")) == 1


@pytest.mark.parametrize("by", CLIENTS)
def test_second_node_of_a_name_replaces_the_first(ros: RosSession, by: Client) -> None:
    listener = ros.listener("rospy", "/chatter")
    first = ros.talker(by, "/chatter", "--text", "first", name="voice")
    listener.wait_for(event="received")
    ros.talker(by, "/chatter", "--text", "second", name="voice")
    first.wait()
    listener.wait_for(lambda event: event.get("data", "").startswith("second"))


@pytest.mark.parametrize("by", CLIENTS)
def test_talker_notices_that_the_listener_left(ros: RosSession, by: Client) -> None:
    talker = ros.talker(by, "/chatter")
    listener = ros.listener("roscpp", "/chatter")
    talker.wait_for(event="connected")
    listener.stop()
    talker.wait_for(event="disconnected")


@pytest.mark.real
@pytest.mark.parametrize("to", CLIENTS)
@pytest.mark.parametrize("by", CLIENTS)
def test_service(ros: RosSession, by: Client, to: Client) -> None:
    server = ros.service_server(by, "/negate")
    client = ros.service_client(to, "/negate", name="asker")
    for number, given in enumerate(("true", "false", "true")):
        client.send(given)
        answers = client.wait_for_count(number + 1, event="answered")
        assert answers[-1]["success"] is (given != "true")
    calls = server.wait_for_count(3, event="called")
    assert [(event["data"], event["client"]) for event in calls] == [
        (True, "/asker"),
        (False, "/asker"),
        (True, "/asker"),
    ]


@pytest.mark.parametrize("client", CLIENTS)
def test_persistent_service_connection(ros: RosSession, client: Client) -> None:
    ros.service_server("roscpp", "/negate")
    asker = ros.service_client(client, "/negate", "--persistent")
    for number in range(3):
        asker.send("false")
        assert asker.wait_for_count(number + 1, event="answered")[-1]["success"] is True


@pytest.mark.parametrize("client", CLIENTS)
def test_missing_service(ros: RosSession, client: Client) -> None:
    asker = ros.service_client(client, "/nobody")
    asker.send("true")
    asker.wait_for(event="failed")
    ros.service_server("rospy", "/nobody")
    asker.send("true")
    asker.wait_for(event="answered")


@pytest.mark.real
def test_watched_parameter(ros: RosSession) -> None:
    python, cpp = ros.parameters("rospy"), ros.parameters("roscpp")
    python.send(json.dumps({"do": "set", "key": "/speed", "value": "slow"}))
    python.wait_for(event="done", do="set")
    python.send(json.dumps({"do": "watch", "key": "/speed"}))
    python.wait_for(event="done", do="watch", value="slow")
    cpp.send("watch /speed")
    cpp.wait_for(event="done", do="watch", value="slow")
    cpp.send("set /speed fast")
    cpp.wait_for(event="changed", value="fast")
    python.wait_for(event="changed", key="/speed/", value="fast")
    cpp.send("delete /speed")
    cpp.wait_for(event="done", do="delete")


def test_nodes_on_two_hosts(site: Site, ros: RosSession) -> None:
    elsewhere = ros.on(site.ocu)
    here, there = ros.listener("rospy", "/down"), elsewhere.listener("roscpp", "/up")
    ros.talker("roscpp", "/up", name="robot_voice")
    elsewhere.talker("rospy", "/down", name="ocu_voice")
    assert here.wait_for(event="received")["publisher"] == "/ocu_voice"
    assert there.wait_for(event="received")["publisher"] == "/robot_voice"


@pytest.mark.real
def test_relative_and_private_names(ros: RosSession) -> None:
    listener = ros.listener("roscpp", "/left/chatter")
    ros.talker("rospy", "chatter", "__ns:=/left")
    listener.wait_for(event="received")
    other = ros.listener("rospy", "/heard")
    ros.talker("roscpp", "/said", "/said:=/heard", name="remapped")
    other.wait_for(event="received", publisher="/remapped")


@pytest.mark.real
def test_action(ros: RosSession) -> None:
    server = ros.node("rospy", "action", "server", name="counter")
    client = ros.node("rospy", "action", "client", name="asker")
    assert client.wait_for(event="result") == {"event": "result", "result": 3, "state": 3}
    assert [event["number"] for event in client.seen(event="feedback")] == [1, 2, 3]
    assert len(server.wait_for_count(1, event="executed")) == 1
