import resource
import signal
import socket
import struct
from functools import partial
from pathlib import Path
from typing import BinaryIO

import pytest

from appliance.channel.messages import (
    ConnectionClosed,
    ConnectionOpened,
    ConnectionRefused,
    FactWithdrawn,
    GrantInstalled,
    TrafficReported,
    UpstreamLost,
)
from roswire.tcpros import HeaderParser, encode_header
from tests.support.nodes import Client, RosSession, numbers, without_gap
from tests.support.relay_driver import LOOPBACK, Face, RelayDriver
from tests.support.waiting import eventually

BOTH: tuple[Client, Client] = ("rospy", "roscpp")
STRING = {"type": "std_msgs/String", "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1"}


def rss(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * resource.getpagesize()


def subscribe(face: Face, fields: dict[str, str]) -> tuple[socket.socket, dict[str, str]]:
    sock = socket.create_connection((LOOPBACK, face.port), timeout=20)
    sock.sendall(encode_header(fields))
    parser = HeaderParser()
    while True:
        data = sock.recv(1)
        assert data, "closed without a header"
        header = parser.feed(data)
        if header is not None:
            return sock, header


def _refused(message: object, resource: str, caller_id: str) -> bool:
    return isinstance(message, ConnectionRefused) and (message.resource, message.caller_id) == (
        resource,
        caller_id,
    )


def read_frame(stream: BinaryIO) -> bytes:
    (length,) = struct.unpack("<I", stream.read(4))
    return stream.read(length)


@pytest.mark.parametrize("subscriber", BOTH)
@pytest.mark.parametrize("publisher", BOTH)
def test_messages_arrive_with_the_publishers_name(
    driver: RelayDriver, ros: RosSession, publisher: Client, subscriber: Client
) -> None:
    ros.talker(publisher, "/chatter", name="talker")
    listener = ros.listener(subscriber, "/chatter", name="listener")
    events = listener.wait_for_count(5, event="received")
    assert {event["publisher"] for event in events} == {"/talker"}
    assert without_gap(numbers(events))
    opened = driver.link.wait_for(lambda message: isinstance(message, ConnectionOpened))
    assert (opened.resource, opened.kind, opened.caller_id) == ("/chatter", "topic", "/listener")
    listener.stop()
    closed = driver.link.wait_for(lambda message: isinstance(message, ConnectionClosed))
    assert closed == ConnectionClosed(opened.number, "")


@pytest.mark.parametrize("publisher", BOTH)
def test_a_latched_message_reaches_early_and_late_subscribers_once(
    driver: RelayDriver, ros: RosSession, publisher: Client
) -> None:
    talker = ros.talker(publisher, "/map", "--latch")
    first = ros.listener("rospy", "/map")
    first.wait_for(event="received")
    second = ros.listener("roscpp", "/map")
    second.wait_for(event="received")
    talker.wait_for(event="connected")
    third = ros.listener("rospy", "/map")
    third.wait_for(event="received")
    for listener in (first, second, third):
        assert [event["data"] for event in listener.seen(event="received")] == ["hello 1"]
    assert len(talker.seen(event="connected")) == 1, "the publisher sees one connection"


def test_each_subscriber_gets_the_latched_message_of_each_handle(
    driver: RelayDriver, ros: RosSession
) -> None:
    """A nodelet manager with several static transforms, or rosbag that plays them, has several handles."""
    ros.talker("roscpp", "/tf_static", "--latch", "--handles", "3", "--rate", "20")
    listeners = []
    for client in ("rospy", "roscpp", "rospy"):
        listeners.append(ros.listener(client, "/tf_static"))
        listeners[-1].wait_for_count(3, event="received")
    for listener in listeners:
        received = [event["data"] for event in listener.seen(event="received")]
        assert sorted(received) == ["hello 1", "hello 2", "hello 3"]


def test_a_stopped_subscriber_neither_delays_others_nor_grows_memory(
    driver: RelayDriver, ros: RosSession
) -> None:
    ros.talker("roscpp", "/chatter", "--rate", "100", "--text", "x" * 60_000)
    stuck = ros.listener("roscpp", "/chatter", name="stuck")
    stuck.wait_for(event="received")
    stuck.popen.send_signal(signal.SIGSTOP)
    try:
        well = ros.listener("roscpp", "/chatter", name="well")
        dropped = driver.link.wait_for(
            lambda message: (
                isinstance(message, TrafficReported)
                and any(row.resource == "/chatter" and row.dropped for row in message.rows)
            ),
            seconds=60,
        )
        assert dropped
        assert rss(driver.relay.process.pid) < 300 << 20
        mark = well.mark()
        well.wait_for(lambda event: True, since=mark, event="received")
        assert without_gap(numbers(well.seen(event="received")))
    finally:
        stuck.popen.send_signal(signal.SIGCONT)
    mark = stuck.mark()
    stuck.wait_for(since=mark, event="received")
    heard = numbers(stuck.seen(event="received"))
    assert heard == sorted(heard), "its messages are in order"


def test_a_message_of_ten_megabytes_arrives_whole(driver: RelayDriver, ros: RosSession) -> None:
    program = (
        "import rospy, sys\n"
        "from std_msgs.msg import String\n"
        "rospy.init_node('big')\n"
        "p = rospy.Publisher('/big', String, queue_size=10)\n"
        'print(\'{"event": "ready"}\', flush=True)\n'
        "while p.get_num_connections() < 1 and not rospy.is_shutdown(): rospy.sleep(0.02)\n"
        "for n in (5, 10_000_000, 5, 3_000_000, 3_000_000, 0):\n"
        "    p.publish(chr(97 + n % 7) * n)\n"
        "rospy.spin()\n"
    )
    node = ros.start(["/usr/bin/python3", "-c", program], label="big")
    node.wait_for(event="ready")
    face = driver.faces["/big"]
    driver.link.send(GrantInstalled(face.key, "/big", LOOPBACK, "/raw"))
    eventually(lambda: "/big" in face.publications, "the topic is registered")
    sock, _header = subscribe(face, {"callerid": "/raw", "topic": "/big", **STRING})
    with sock, sock.makefile("rb") as stream:
        for size in (5, 10_000_000, 5, 3_000_000, 3_000_000, 0):
            body = read_frame(stream)
            assert struct.unpack_from("<I", body)[0] == size
            assert body[4:] == bytes([97 + size % 7]) * size


def test_a_subscriber_without_a_permission_is_not_served(driver: RelayDriver, ros: RosSession) -> None:
    ros.talker("rospy", "/chatter", name="talker")
    face = driver.faces["/talker"]
    driver.link.send(GrantInstalled(face.key, "/chatter", LOOPBACK, "/listener"))
    for fields, reason in (
        ({"callerid": "/unknown", "topic": "/chatter"}, "no grant"),
        ({"callerid": "/listener", "topic": "/rosout"}, "no grant"),
        ({"callerid": "/listener", "topic": "/nothing"}, "not a publisher"),
    ):
        sock, header = subscribe(face, fields | {"md5sum": "*", "type": "*"})
        sock.close()
        assert reason in header["error"]
        refused = driver.link.wait_for(
            partial(_refused, resource=fields["topic"], caller_id=fields["callerid"])
        )
        assert (refused.host, refused.count) == (LOOPBACK, 1)


def test_a_subscriber_of_another_type_gets_an_error(driver: RelayDriver, ros: RosSession) -> None:
    ros.talker("rospy", "/chatter", name="talker")
    face = driver.faces["/talker"]
    driver.link.send(GrantInstalled(face.key, "/chatter", LOOPBACK, "/listener"))
    fields = {"callerid": "/listener", "topic": "/chatter", "type": "std_msgs/Int32", "md5sum": "0" * 32}
    sock, header = subscribe(face, fields)
    sock.close()
    assert header == {"error": "topic types do not match: [std_msgs/Int32] vs. [std_msgs/String]"}


def test_a_connection_is_for_one_topic(driver: RelayDriver, ros: RosSession) -> None:
    ros.talker("rospy", "/chatter", name="talker")
    face = driver.faces["/talker"]
    driver.link.send(GrantInstalled(face.key, "/chatter", LOOPBACK, "/listener"))
    sock, header = subscribe(face, {"callerid": "/listener", "topic": "/chatter", **STRING})
    assert header["type"] == "std_msgs/String"
    with sock:
        sock.sendall(encode_header({"callerid": "/listener", "topic": "/rosout", "md5sum": "*", "type": "*"}))
        driver.link.wait_for(
            lambda message: isinstance(message, ConnectionRefused) and "one topic" in message.reason
        )
        driver.link.wait_for(lambda message: isinstance(message, ConnectionClosed))


def test_traffic_continues_while_control_restarts(driver: RelayDriver, ros: RosSession) -> None:
    ros.talker("roscpp", "/chatter", "--rate", "50")
    listener = ros.listener("roscpp", "/chatter", name="listener")
    listener.wait_for(event="received")
    driver.link.close()
    mark = listener.mark()
    listener.wait_for(since=mark, event="received")
    driver.restart_control()
    opened = driver.link.wait_for(lambda message: isinstance(message, ConnectionOpened))
    assert opened.caller_id == "/listener"
    listener.wait_for_count(50, event="received")
    assert without_gap(numbers(listener.seen(event="received")))


def test_a_connection_that_a_new_control_does_not_restate_is_closed(
    driver: RelayDriver, ros: RosSession
) -> None:
    ros.talker("rospy", "/chatter")
    out, stays = (
        ros.listener("rospy", "/chatter", name="out"),
        ros.listener("roscpp", "/chatter", name="stays"),
    )
    for listener in (out, stays):
        listener.wait_for(event="received")
    driver.restart_control(
        leave_out=lambda message: isinstance(message, GrantInstalled) and message.caller_id == "/out"
    )
    closed = driver.link.wait_for(lambda message: isinstance(message, ConnectionClosed))
    assert "grant" in closed.reason
    stays.wait_for_count(20, event="received", since=stays.mark())
    last_out, last_stays = (numbers(one.seen(event="received"))[-1] for one in (out, stays))
    assert last_out < last_stays - 10


def test_a_revocation_closes_its_connection(driver: RelayDriver, ros: RosSession) -> None:
    ros.talker("rospy", "/chatter", name="talker")
    face = driver.faces["/talker"]
    ros.listener("roscpp", "/chatter", name="listener").wait_for(event="received")
    driver.link.send(FactWithdrawn(("grant", face.key, "/chatter", LOOPBACK, "/listener")))
    closed = driver.link.wait_for(lambda message: isinstance(message, ConnectionClosed))
    assert closed.reason == "its grant is revoked"


def test_a_republished_topic_is_served_again(driver: RelayDriver, ros: RosSession) -> None:
    first = ros.talker("rospy", "/chatter", name="talker")
    listener = ros.listener("rospy", "/chatter", name="listener")
    listener.wait_for(event="received")
    first.kill()
    driver.link.wait_for(lambda message: isinstance(message, UpstreamLost))
    ros.talker("rospy", "/chatter", "--text", "again", name="talker")
    listener.wait_for(lambda event: str(event.get("data", "")).startswith("again"), event="received")


def test_the_stock_tools_read_through_the_relay(driver: RelayDriver, ros: RosSession) -> None:
    ros.talker("roscpp", "/chatter")
    assert "hello" in ros.run("/usr/bin/rostopic", "echo", "-n", "2", "/chatter").stdout
