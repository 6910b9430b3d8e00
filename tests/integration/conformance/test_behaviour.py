import itertools
import time
from typing import Any
from xmlrpc.client import ServerProxy

import pytest

from tests.integration.conformance.fake_nodes import FakeNodes
from tests.integration.conformance.nodes import order, roscpp_node, rospy_node
from tests.support.nodes import Client, RosSession, numbers, without_gap
from tests.support.processes import LIMIT, Process
from tests.support.site import Site
from tests.support.waiting import eventually

CLIENTS: list[Client] = ["rospy", "roscpp"]
TOPIC_TOOLS = "/usr/lib/topic_tools"


def texts(node: Process) -> list[str]:
    return [event["data"] for event in node.seen(event="received")]


def test_own_topic_rospy(ros: RosSession) -> None:
    node = rospy_node(ros, "orders", "loop")
    order(node, "subscribe", topic="/loop")
    order(node, "advertise", topic="/loop")
    ros.talker("roscpp", "/loop", "--text", "other", name="other")
    ear = ros.listener("roscpp", "/loop")
    node.wait_for(event="received", publisher="/other")
    order(node, "publish", topic="/loop", text="first")  # its connection to itself may still be in progress
    for number in itertools.count():
        order(node, "publish", topic="/loop", text=f"mine {number}")
        if "/loop" in {event["publisher"] for event in ear.seen(event="received")} & {
            event["publisher"] for event in node.seen(event="received")
        }:
            break
        ear.wait_for(event="received", since=ear.mark())
    order(node, "publish", topic="/loop", text="last")
    for heard in (node, ear):
        heard.wait_for(event="received", data="last", publisher="/loop")
    own = [event["data"] for event in node.seen(event="received", publisher="/loop")]
    assert len(own) == len(set(own)), "each of its own messages arrives once"


def test_own_topic_roscpp(ros: RosSession) -> None:
    node = roscpp_node(ros, "loop", "loop", "/loop")
    ros.talker("rospy", "/loop", "--text", "other", name="other")
    ear = ros.listener("rospy", "/loop")
    ear.wait_for(event="received", publisher="/loop")
    node.wait_for(event="received", publisher="/other")
    node.wait_for_count(5, event="received", publisher="/loop")
    own = [event["data"] for event in node.seen(event="received", publisher="/loop")]
    assert len(own) == len(set(own)), "each of its own messages arrives once"


def test_dynamic_subscriptions(ros: RosSession) -> None:
    node, talker = rospy_node(ros, "orders", "dynamic"), rospy_node(ros, "orders", "source")
    order(talker, "advertise", topic="/d", latch=True)
    for number in range(5):
        order(talker, "publish", topic="/d", text=f"round {number}")
        order(node, "subscribe", topic="/d")
        node.wait_for(event="received", data=f"round {number}")
        order(node, "unsubscribe", topic="/d")
    order(node, "subscribe", topic="/d")
    node.wait_for_count(
        2, event="received", data="round 4"
    )  # rospy loses a publisher that ends while it connects
    for number in range(5):
        order(talker, "unadvertise", topic="/d")
        order(node, "abandoned", topic="/d")
        order(talker, "advertise", topic="/d", latch=True)
        order(talker, "publish", topic="/d", text=f"again {number}")
        node.wait_for(event="received", data=f"again {number}")


@pytest.mark.parametrize("by", CLIENTS)
def test_publisher_restarted_again_and_again(ros: RosSession, by: Client) -> None:
    ears = [ros.listener(to, "/chatter") for to in CLIENTS]
    for number in range(20 if by == "roscpp" else 4):  # a rospy node takes a second to end
        voice = ros.talker(by, "/chatter", "--text", f"life {number}", name="voice")
        for ear in ears:
            ear.wait_for(lambda event, number=number: event.get("data", "").startswith(f"life {number} "))  # type: ignore[misc]  # mypy does not infer a lambda with defaults
        if number % 2:
            voice.kill()
        else:
            voice.stop()


def test_killed_node_is_replaced(ros: RosSession) -> None:
    ros.service_server("roscpp", "/negate", name="server").kill()
    ros.service_server("rospy", "/negate", name="server")
    asker = ros.service_client("roscpp", "/negate")
    asker.send("true")
    assert asker.wait_for(event="answered")["success"] is False
    ros.listener("rospy", "/chatter", name="ear").kill()
    ear = ros.listener("roscpp", "/chatter", name="ear")
    ros.talker("rospy", "/chatter")
    ear.wait_for(event="received")


def test_simulated_time(ros: RosSession) -> None:
    ros.run("rosparam", "set", "/use_sim_time", "true")
    try:
        node = rospy_node(ros, "orders", "dreamer")
        assert order(node, "now")["seconds"] == 0
        ros.start(["rostopic", "pub", "-r", "20", "/clock", "rosgraph_msgs/Clock", "clock: {secs: 1234}"])
        eventually(lambda: order(node, "now")["seconds"] == 1234, ros.story)
    finally:
        ros.run("rosparam", "delete", "/use_sim_time")


def test_rosout_is_aggregated(ros: RosSession) -> None:
    agg = ros.start(["rostopic", "echo", "/rosout_agg/msg"])
    nodes = [rospy_node(ros, "orders", f"logger_{number}") for number in range(3)]
    deadline = time.monotonic() + 2 * LIMIT
    for number, node in enumerate(nodes):
        # The aggregator and its echo may still be connecting.
        while not any(f"word of {number}" in event.get("text", "") for event in agg.seen()):
            order(node, "log", text=f"word of {number}")
            assert time.monotonic() < deadline, ros.story()


def test_topic_tools(ros: RosSession) -> None:
    ros.start([f"{TOPIC_TOOLS}/relay", "/in_a", "/out"])
    ros.start([f"{TOPIC_TOOLS}/throttle", "messages", "/in_a", "2", "/slow"])
    ros.start([f"{TOPIC_TOOLS}/mux", "/sel", "/in_a", "/in_b", "mux:=the_mux"])
    out, slow, sel = (ros.listener("roscpp", topic) for topic in ("/out", "/slow", "/sel"))
    ros.talker("rospy", "/in_a", "--text", "a", name="a")
    ros.talker("roscpp", "/in_b", "--text", "b", name="b")
    out.wait_for(event="received")
    slow.wait_for_count(4, event="received")
    sel.wait_for(lambda event: event.get("data", "").startswith("a "))
    assert not any(text.startswith("b ") for text in texts(sel))
    assert ros.run("rosservice", "type", "/the_mux/select").stdout.strip() == "topic_tools/MuxSelect"
    assert without_gap(numbers(out.seen(event="received")))
    assert not without_gap(numbers(slow.seen(event="received")))


def test_anonymous_and_remapped_names(ros: RosSession) -> None:
    ear = rospy_node(ros, "orders", "ear")
    order(ear, "subscribe", topic="~inbox")
    pubs = [
        ros.start(["rostopic", "pub", "-r", "10", "/ear/inbox", "std_msgs/String", f"data: from {number}"])
        for number in range(2)
    ]
    for number in range(2):
        ear.wait_for(event="received", data=f"from {number}")
    assert len({event["publisher"] for event in ear.seen(event="received")}) == 2
    pubs[0].stop()
    ear.wait_for(event="received", data="from 1", since=ear.mark())


def test_wrong_type_is_not_connected(ros: RosSession) -> None:
    ros.talker("roscpp", "/typed", name="right")
    wrong = ros.start(["rostopic", "pub", "-r", "10", "/typed", "std_msgs/Bool", "true"])
    ear = ros.listener("rospy", "/typed")
    ear.wait_for_count(3, event="received")
    assert {event["publisher"] for event in ear.seen(event="received")} == {"/right"}
    assert wrong.running


def test_actions(ros: RosSession) -> None:
    rospy_node(ros, "action_server", "counter")
    client = rospy_node(ros, "action_client", "asker")
    assert client.wait_for(event="reached")["result"] == 5
    cancelled = client.wait_for(event="cancelled")
    assert (cancelled["state"], cancelled["feedback"] > 0) == (2, True)  # the goal's status is PREEMPTED
    assert client.wait() == 0


def test_hundred_nodes_of_ten_topics(local: Site) -> None:
    with FakeNodes() as nodes, ServerProxy(local.master_uri) as server:
        master: Any = server
        start = time.monotonic()
        for node in range(100):
            uri = nodes.uri(f"n{node}")
            for topic in range(10):
                for method, name in (
                    ("registerPublisher", f"/n{node}/t{topic}"),
                    ("registerSubscriber", f"/n{(node + 1) % 100}/t{topic}"),
                ):
                    answer = getattr(master, method)(f"/n{node}", name, "std_msgs/String", uri)
                    assert answer[0] == 1, answer
        print(f"{local.mode}: 2000 registrations in {time.monotonic() - start:.2f} s")  # noqa: T201  a figure for the reader of the run
        publishers, subscribers, _services = master.getSystemState("/test")[2]
        wanted = [f"/n{node}/t{topic}" for node in range(100) for topic in range(10)]
        assert [name for name, _nodes in publishers if name.startswith("/n")] == wanted
        assert sorted(name for name, _nodes in subscribers if name.startswith("/n")) == sorted(wanted)
        assert nodes.wait_until(lambda: len(_told(nodes)) == 1000), "every subscriber is told its publisher"
        parts = [
            {
                "methodName": method,
                "params": [f"/n{node}", f"/n{(node + one) % 100}/t{topic}", nodes.uri(f"n{node}")],
            }
            for node in range(100)
            for topic in range(10)
            for method, one in (("unregisterPublisher", 0), ("unregisterSubscriber", 1))
        ]
        assert all(answer[0][0] == 1 for answer in master.system.multicall(parts))


def _told(nodes: FakeNodes) -> set[tuple[str, str]]:
    names = [f"n{node}" for node in range(100)]
    told = {(name, topic) for name in names for topic, _uris in nodes.calls(name, "publisherUpdate")}
    return told | {("n99", f"/n0/t{topic}") for topic in range(10)}
