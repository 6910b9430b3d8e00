import json
import re
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.support.waiting import eventually

SECONDS = 20.0
POLICY = """
[Groups]
site = 10.77.0.0/24
agent = door:agent-1
[Nodes]
default = site agent
[Publishers]
default = site
/answer = site agent
[Subscribers]
default = site agent
/secret = site
[Services]
default = site
[Clients]
default = site
/brake = site agent
[Commands]
default = site agent
[Parameters]
read default = site agent
write default = site
"""
AGENT = "ws://10.77.0.2:9091"
MAX_KB = 400 << 10
LARGE = """
import rospy
from std_msgs.msg import String
rospy.init_node("large")
publisher, rate = rospy.Publisher("/large", String, queue_size=1), rospy.Rate(3)
while not rospy.is_shutdown():
    publisher.publish("x" * 30_000_000)
    rate.sleep()
"""
HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: 10.77.0.2\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


@pytest.fixture(scope="module")
def appliance(common_lab: Lab) -> Iterator[Appliance]:
    host = common_lab.host("appliance", "10.77.0.2/24")
    settings = "api_networks: [10.77.0.0/24]\n"
    with Appliance(host, policy=POLICY, settings=settings, options=("--api", "10.77.0.2:8443")) as running:
        running.rosrv("door", "add", "agent-1", "--port", "9091", "--from", "10.77.0.10")
        yield running


def stuck_client() -> socket.socket:
    client = socket.create_connection(("10.77.0.2", 9091), SECONDS)
    client.sendall(HANDSHAKE)
    assert b" 101 " in client.recv(1000)
    return client


def client_frame(**operation: str) -> bytes:
    text = json.dumps(operation).encode()
    return bytes([0x81, 0x80 | len(text)]) + bytes(4) + text


def on_robot(robot: Host, work: Callable[[], Any]) -> Any:
    return robot.run(work)


def frame(client: ClientConnection, **wanted: Any) -> Any:
    while True:
        found = json.loads(client.recv(SECONDS))
        if all(found.get(name) == value for name, value in wanted.items()):
            return found


def test_an_agent_hears_publishes_and_calls_within_its_rights(
    appliance: Appliance, common_robot: Host, tmp_path: Path
) -> None:
    with RosSession(appliance.master_uri, tmp_path, common_robot) as ros:
        ros.talker("rospy", "/chatter")
        listener = ros.listener("rospy", "/answer")
        ros.service_server("roscpp", "/brake")
        eventually(lambda: not appliance.row("door", "list")["trouble"], "the door serves")

        def work() -> None:
            with connect(AGENT) as client:
                client.send(json.dumps({"op": "subscribe", "topic": "/chatter", "type": "std_msgs/String"}))
                assert frame(client, op="publish")["msg"]["data"].startswith("hello ")
                assert appliance.status()["ipsec"]["ports"].keys() == {"10.77.0.10"}  # no door
                client.send(json.dumps({"op": "advertise", "topic": "/answer", "type": "std_msgs/String"}))
                client.send(json.dumps({"op": "publish", "topic": "/answer", "msg": {"data": "first"}}))
                client.send(json.dumps({"op": "call_service", "service": "/brake", "args": [True], "id": 1}))
                assert frame(client, op="service_response", id=1)["result"] is True
                client.send(
                    json.dumps({"op": "advertise", "topic": "/cmd", "type": "std_msgs/String", "id": "a"})
                )
                denied = frame(client, op="status", id="a")
                assert denied["level"] == "error"
                assert "policy.ini:8" in denied["msg"], denied
                client.send(json.dumps({"op": "call_service", "service": "/other", "id": 2}))
                refused = frame(client, op="service_response", id=2)
                assert refused["result"] is False
                assert refused["values"]["message"]

        on_robot(common_robot, work)
        assert listener.wait_for(event="received")["data"] == "first"
    [denial] = appliance.recorded("--deny", resource="/cmd")
    assert denial["host"].startswith("198.19.240.")


def test_large_messages_for_clients_that_read_nothing_take_bounded_memory(
    appliance: Appliance, common_robot: Host, tmp_path: Path
) -> None:
    program = tmp_path / "large.py"
    program.write_text(LARGE)
    with RosSession(appliance.master_uri, tmp_path, common_robot) as ros, ExitStack() as stack:
        ros.talker("rospy", "/chatter")
        ros.start(["/usr/bin/python3", str(program)], label="large")
        eventually(lambda: not appliance.row("door", "list")["trouble"], "the door serves")
        pid = appliance.pids("door")[-1]

        def work() -> None:
            for _number in range(20):
                stuck = stack.enter_context(stuck_client())
                stuck.sendall(client_frame(op="subscribe", topic="/large", compression="cbor-raw"))
                threading.Event().wait(1)
                stuck.sendall(client_frame(op="unsubscribe", topic="/large"))
            with connect(AGENT) as client:
                client.send(json.dumps({"op": "subscribe", "topic": "/chatter", "type": "std_msgs/String"}))
                for _number in range(20):
                    frame(client, op="publish", topic="/chatter")

        on_robot(common_robot, work)
        [peak] = re.findall(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
        assert int(peak) < MAX_KB
        assert appliance.row("door", "list")["dropped"] > 0


def test_a_client_that_does_not_finish_a_message_is_disconnected_and_recorded(
    appliance: Appliance, common_robot: Host
) -> None:
    eventually(lambda: not appliance.row("door", "list")["trouble"], "the door serves")

    def work() -> bytes:
        with stuck_client() as client:
            client.sendall(bytes([0x01, 0x81]) + bytes(4) + b"{")  # a text without its end
            return b"".join(iter(lambda: client.recv(1000), b""))

    end = on_robot(common_robot, work)
    assert end[:1] == b"\x88" and end[2:4] == (1008).to_bytes(2) and b"of what it has begun" in end

    def reasons() -> list[str]:
        return [one["reason"] for one in appliance.audit(event="door disconnected", resource="agent-1")]

    eventually(lambda: any("of what it has begun" in one for one in reasons()), "the record has the reason")


AS_A_DOOR = """
import socket, sys
address, role = sys.argv[1:]
with socket.socket() as own:
    own.settimeout(5)
    own.bind((address, 0))
    try:
        if role == "begins":
            own.connect(("10.77.0.2", 11311))
        else:
            own.listen()
            with socket.socket() as other:
                other.settimeout(2)
                other.connect(own.getsockname())
        print("passed")
    except OSError as error:
        print("refused")
"""


@pytest.mark.parametrize("role", ["begins", "listens"])
def test_no_other_account_uses_the_address_of_a_door(appliance: Appliance, role: str) -> None:
    address = appliance.rows("door", "list")[0]["address"]

    def used(source: str) -> str:
        script = [sys.executable, "-c", AS_A_DOOR, source, role]
        ran = subprocess.run(script, user=65534, stdout=subprocess.PIPE, check=True, timeout=SECONDS)
        return ran.stdout.decode().strip()

    machine = cast(Host, appliance.host)
    assert on_robot(machine, lambda: used("10.77.0.2")) == "passed"
    assert on_robot(machine, lambda: used(address)) == "refused"


def test_a_ticket_opens_the_door_of_a_person_until_it_is_over(
    appliance: Appliance, common_robot: Host, tmp_path: Path
) -> None:
    appliance.rosrv("door", "add", "alice")
    made = appliance.rosrv("door", "ticket", "alice", "--for", "8s").stdout.strip()
    url = made.replace("ADDRESS:8443", "10.77.0.2:8443")
    trusting = ssl.create_default_context()
    trusting.check_hostname, trusting.verify_mode = False, ssl.CERT_NONE
    eventually(lambda: not appliance.rows("door", "list")[-1]["trouble"], "the door serves")

    def refused() -> None:
        for wrong in (
            url[:-1] + ("A" if url[-1] != "A" else "B"),
            url.replace("/alice", "/agent-1"),
            url.partition("?")[0],
        ):
            with pytest.raises(InvalidStatus) as error, connect(wrong, ssl=trusting):
                pass
            assert error.value.response.status_code == 401

    def work() -> None:
        with connect(url, ssl=trusting, subprotocols=[Subprotocol("foxglove.sdk.v1")]) as client:
            assert client.subprotocol == "foxglove.sdk.v1"
            assert frame(client, op="serverInfo")
            appliance.kill("control")
            with pytest.raises(ConnectionClosed, match="ticket is over"):
                while True:
                    client.recv(SECONDS)

    on_robot(common_robot, refused)
    on_robot(common_robot, work)
    secret = url.rpartition(".")[2]
    assert appliance.recorded(event="door disconnected", resource="alice")
    assert secret not in json.dumps(appliance.recorded())


def test_doors_survive_a_restart_and_a_removed_one_ends(
    appliance: Appliance, common_robot: Host, tmp_path: Path
) -> None:
    def work() -> None:
        with connect(AGENT) as client:
            client.send(json.dumps({"op": "subscribe", "topic": "/drive"}))
            assert frame(client, op="publish")["msg"]["left"] == [], "its type is learnt again"
            client.send(json.dumps({"op": "call_service", "service": "/rosapi/get_time", "id": 1}))
            assert frame(client, op="service_response")["result"] is True
            appliance.rosrv("door", "remove", "agent-1")
            with pytest.raises(ConnectionClosed):
                while True:
                    client.recv(SECONDS)
        with pytest.raises(OSError, match="refused"):
            eventually(lambda: connect(AGENT).close_code, "the port closes", 1)

    with RosSession(appliance.master_uri, tmp_path, common_robot) as ros:
        ros.node("rospy", "drive", "/drive", "left", name="base")
        before = appliance.rows("door", "list")
        appliance.stop()
        appliance.start()
        eventually(
            lambda: not any(row["trouble"] for row in appliance.rows("door", "list")), "the doors serve"
        )
        after = appliance.rows("door", "list")
        assert [(row["name"], row["address"]) for row in after] == [
            (row["name"], row["address"]) for row in before
        ]
        on_robot(common_robot, work)
    added = appliance.row("door", "list")
    assert added["name"] == "alice"
    new = appliance.rosrv("door", "add", "bob").stdout
    assert before[0]["address"] not in new
    again = appliance.rosrv("door", "add", "agent-1", "--port", "9091").stdout
    assert before[0]["address"] in again


def test_doors_of_an_appliance_in_its_own_namespace(lab: Lab, robot: Host) -> None:
    machine = lab.host("appliance", "10.77.0.2/24")
    settings, rest = "api_networks: [10.77.0.0/24]\n", ("--api", "0.0.0.0:8443")
    call = json.dumps({"op": "call_service", "service": "/rosapi/get_time", "id": 1})
    trusting = ssl.create_default_context()
    trusting.check_hostname, trusting.verify_mode = False, ssl.CERT_NONE

    def answered(url: str) -> bool:
        with connect(url, ssl=trusting if url.startswith("wss:") else None) as client:
            client.send(call)
            return bool(frame(client, op="service_response", id=1)["result"])

    with Appliance(machine, isolation="netns", policy=POLICY, settings=settings, options=rest) as running:
        running.rosrv("door", "add", "agent-1", "--port", "9091", "--from", "10.77.0.10")
        running.rosrv("door", "add", "alice")
        ticket = running.rosrv("door", "ticket", "alice").stdout.strip().replace("ADDRESS", "10.77.0.2")
        eventually(lambda: not any(row["trouble"] for row in running.rows("door", "list")), running.story)
        assert on_robot(robot, lambda: answered(AGENT))
        assert on_robot(robot, lambda: answered(ticket))
        running.rosrv("door", "remove", "agent-1")
        with pytest.raises(OSError, match="refused"):
            on_robot(robot, lambda: eventually(lambda: connect(AGENT).close_code, "the port closes", 1))
