"""Attacks that need real connections. `tests/unit/master/conversations/attacks.txt` has those that consist of calls.

After each attack the robot's talker and its operator's listener still run.
"""

import contextlib
import re
import socket
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from appliance.network.scan import scan
from tests.support.field import Field, Impostor, answering, response
from tests.support.processes import LIMIT

POLICY = """\
[Groups]
own   = 10.77.0.10 10.77.0.20
rogue = 10.77.0.66
all   = own rogue

[Nodes]
default    = all

[Publishers]
default    = own
/shared/** = all
/rosout    = all

[Subscribers]
default    = own
/shared/** = all

[Services]
default    = own
/shared/** = all

[Clients]
default    = own
/shared/** = all

[Parameters]
read default = all

[Commands]
default  = all
shutdown = own
"""
ROGUE = r"10\.77\.0\.66"
TCPROS = [["TCPROS"]]
LOOPBACK = "0100007F"  # as /proc/net/tcp writes 127.0.0.1


@pytest.fixture(scope="module", autouse=True)
def graph(battlefield: Field) -> None:
    battlefield.ros.service_server("roscpp", "/shared/negate", name="shared_negator")
    battlefield.ros.talker("roscpp", "/shared/talk", name="shared_voice")


@pytest.fixture(autouse=True)
def no_hidden_port_is_revealed(field: Field) -> Iterator[None]:
    """Check that no answer of the block has a port of `rosmaster`, of a master-side endpoint or of a real node."""
    since = len(field.answers)
    yield
    hidden = {port for address, port in field.middle.run(_listening) if address == LOOPBACK}
    real = {port for _, port in field.robot.run(_listening)} | {port for _, port in field.ocu.run(_listening)}
    assert hidden and real
    for method, answer in field.answers[since:]:
        text = answer.decode("latin-1") if isinstance(answer, bytes) else str(answer)
        told = {
            int(port) for port in re.findall(rf"(?<!{ROGUE}):(\d+)\b", text)
        }  # the rogue knows its own URIs
        assert not told & (hidden | real), f"{method} revealed {told & (hidden | real)}: {text[:500]}"
        assert not re.search(r"\b[0-9a-f]{32}\b", text), f"{method} revealed a key: {text[:500]}"


def outer(field: Field, node: str) -> str:
    code, _text, uri = field.rogue("lookupNode", "/looker", node)
    assert code == 1
    return str(uri)


def test_rosout_receives_every_nodes_log(field: Field) -> None:
    for name in ("voice", "ear"):
        field.recorded(f"is connected to /rosout of /{name}", event="connection opened", caller_id="/rosout")


# --- addresses ---


def test_uri_of_a_third_machine(field: Field) -> None:
    with Impostor(field.unknown_host, answering([1, "", 0])) as third:
        home = field.attacker.run(lambda: socket.create_server(("10.77.0.66", third.port)))
        with home:
            home.settimeout(LIMIT)
            answer = field.rogue(
                "registerSubscriber", "/pointer", "/shared/talk", "std_msgs/String", third.uri
            )
            assert answer[0] == 1
            assert third.uri not in answer[2]
            talker = field.ros.talker("rospy", "/shared/talk", name="second_shared_voice")  # causes an update
            for _ in range(5):  # the first connections only check that the node is there
                connection, peer = home.accept()
                with connection:
                    assert peer[0] == "10.77.0.2"
                    request = connection.recv(4096)
                if request:
                    break
            assert b"POST /" in request
            talker.stop()
        assert third.peers == []


def test_service_of_a_third_machine(field: Field) -> None:
    with (
        Impostor(field.unknown_host, answering([1, "", 0])) as third,
        Impostor(field.attacker, answering([1, "", 0])) as node,
    ):
        uri = f"rosrpc://10.77.0.99:{third.port}"
        assert field.rogue("registerService", "/pointer2", "/shared/away", uri, node.uri)[0] == 1
        home = field.attacker.run(lambda: socket.create_server(("10.77.0.66", third.port)))
        with home:
            home.settimeout(LIMIT)
            code, _text, found = field.call(field.robot, "lookupService", "/looker", "/shared/away")
            assert code == 1
            host, _, port = found.removeprefix("rosrpc://").partition(":")
            assert host == "10.77.0.2"
            with field.connect(field.robot, int(port)) as client:
                client.sendall(header(callerid="/looker", service="/shared/away", md5sum="*", type="*"))
                connection, peer = home.accept()
                connection.close()
                assert peer[0] == "10.77.0.2"
        assert third.peers == []
        assert field.rogue("unregisterService", "/pointer2", "/shared/away", uri)[0] == 1


def header(**fields: str) -> bytes:
    body = b"".join(
        len(one).to_bytes(4, "little") + one
        for one in (f"{key}={value}".encode() for key, value in fields.items())
    )
    return len(body).to_bytes(4, "little") + body


# --- the relay's ports ---


def relay_port(field: Field) -> int:
    code, _text, protocol = field.rogue(
        "requestTopic", "/taker", "/shared/talk", TCPROS, uri=outer(field, "/shared_voice")
    )
    assert code == 1
    return int(protocol[2])


def knock(field: Field, port: int, data: bytes) -> bytes:
    with field.connect(port=port) as sock:
        sock.sendall(data)
        with contextlib.suppress(ConnectionResetError):
            return sock.recv(65536)
        return b""


STRING = {"type": "std_msgs/String", "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1"}


def test_granted_topic_arrives(field: Field) -> None:
    answer = knock(field, relay_port(field), header(callerid="/taker", topic="/shared/talk", **STRING))
    assert b"callerid=/shared_voice" in answer


@pytest.mark.parametrize(
    "fields",
    [
        {"callerid": "/nobody", "topic": "/shared/talk"},
        {"callerid": "/taker", "topic": "/chatter"},
        {"callerid": "/taker", "topic": "/rosout"},
        {"callerid": "/ear", "topic": "/chatter"},
        {"callerid": "/taker", "service": "/negate"},
        {"callerid": "/taker"},
        {"topic": "/shared/talk"},
    ],
    ids=lambda fields: " ".join(fields.values()),
)
def test_relay_port_without_the_grant(field: Field, fields: dict[str, str]) -> None:
    answer = knock(field, relay_port(field), header(**fields, **STRING))
    assert b"callerid=/shared_voice" not in answer
    assert b"hello" not in answer
    field.recorded(event="connection refused", host="10.77.0.66")


def test_permission_of_another_host(field: Field) -> None:
    uri = field.call(field.ocu, "lookupNode", "/looker2", "/voice")[2]
    code, _text, protocol = field.call(field.ocu, "requestTopic", "/borrowed", "/chatter", TCPROS, uri=uri)
    assert code == 1
    answer = knock(field, protocol[2], header(callerid="/borrowed", topic="/chatter", **STRING))
    assert b"hello" not in answer
    assert b"callerid=/voice" not in answer
    record = field.recorded(event="connection refused", host="10.77.0.66", caller_id="/borrowed")
    why = field.appliance.rosrv("audit", "why", record["id"]).stdout.splitlines()
    assert any(line.startswith("would be allowed by: /chatter = ") for line in why), why


# --- hidden hosts and ports ---


def test_host_that_no_rule_names(field: Field) -> None:
    answer = field.call(field.unknown_host, "getPid", "/unknown")
    assert "no rule of the policy names 10.77.0.99" in answer.faultString
    record = field.recorded(host="10.77.0.99", decision="deny", resource="getPid", caller_id="/unknown")
    assert record["detail"] == {"call": "getPid", "unknown_host": True}
    field.call(field.unknown_host, "registerPublisher", "/evil", "/shared/x", "std_msgs/String", field.api)
    field.recorded(host="10.77.0.99", category="publish", resource="/shared/x", caller_id="/evil")
    wider = field.home / "wider.ini"
    wider.write_text("[Publishers]\n/shared/x = 10.77.0.99\n[Nodes]\ndefault = *\n")
    differs = field.appliance.rosrv(
        "policy", "diff", str(field.appliance.policy_file), str(wider), "--decisions", check=False
    ).stdout
    assert any("/shared/x" in line and "10.77.0.99" in line for line in differs.splitlines()), differs
    face = outer(field, "/voice")
    answer = field.call(field.unknown_host, "getPid", "/unknown", uri=face)
    assert "no rule of the policy names 10.77.0.99" in answer.faultString


def test_port_scan(field: Field) -> None:
    hidden = {port for address, port in field.middle.run(_listening) if address == LOOPBACK}
    assert hidden, "rosmaster and the master-side endpoints listen somewhere"
    scanned = field.attacker.run(lambda: scan("10.77.0.2", range(1, 65536), 0.3))
    open_ports = set(scanned.open)
    assert 11311 in open_ports
    assert {port for port in open_ports if not 19001 <= port <= 26000} == {11311}
    assert not open_ports & hidden


def _listening() -> set[tuple[str, int]]:
    table = Path("/proc/thread-self/net/tcp").read_text(encoding="ascii")
    rows = [line.split() for line in table.splitlines()[1:]]
    return {(row[1].split(":")[0], int(row[1].split(":")[1], 16)) for row in rows if row[3] == "0A"}


def test_loopback_listeners_from_another_host(field: Field) -> None:
    hidden = {port for address, port in field.middle.run(_listening) if address == LOOPBACK}
    for port in hidden:
        with pytest.raises(OSError, match=r"timed out|refused|unreachable"):
            field.attacker.run(partial(socket.create_connection, ("10.77.0.2", port), 0.5))


# --- dishonest peers ---


def silent(_connection: socket.socket, _request: bytes) -> None:
    threading.Event().wait(60)


def endless(connection: socket.socket, _request: bytes) -> None:
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: 2147483648\r\n\r\n")
    for _ in range(2048):
        connection.sendall(b" " * (1 << 20))


def twice(connection: socket.socket, _request: bytes) -> None:
    connection.sendall(response([1, "", 1]) + response([1, "", 2]))


def rubbish(connection: socket.socket, _request: bytes) -> None:
    connection.sendall(b"\x00\xff" * 1000)


def redirect(connection: socket.socket, _request: bytes) -> None:
    connection.sendall(
        b"HTTP/1.1 302 Found\r\nLocation: http://10.77.0.99:4444/\r\nContent-Length: 0\r\n\r\n"
    )


def drip(connection: socket.socket, _request: bytes) -> None:
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 100000\r\n\r\n")
    pause = threading.Event()
    for _ in range(600):
        connection.sendall(b" ")
        pause.wait(0.1)


def bomb(connection: socket.socket, _request: bytes) -> None:
    body = b'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]><methodResponse/>'
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % len(body) + body)


@pytest.mark.parametrize(
    "behave", [silent, endless, twice, rubbish, redirect, drip, bomb], ids=lambda one: one.__name__
)
def test_misbehaving_node(field: Field, behave: Any) -> None:
    before = field.memory()
    with Impostor(field.attacker, behave) as node:
        name, topic = f"/liar_{behave.__name__}", f"/shared/liar_{behave.__name__}"
        assert field.rogue("registerPublisher", name, topic, "std_msgs/String", node.uri)[0] == 1
        uri = outer(field, name)
        answers: list[Any] = []

        def ask() -> None:
            try:
                answers.append(field.rogue("getPid", "/asker", uri=uri))
            except ConnectionError as error:
                answers.append(error)

        asking = threading.Thread(target=ask)
        asking.start()
        assert node.called.wait(LIMIT)
        field.unharmed(20)
        asking.join(LIMIT)
        [answer] = answers
        assert isinstance(answer, ConnectionError) != (behave is twice)
        if behave is twice:
            assert len(answer) == 3
            assert isinstance(answer[1], str)
        assert f":{node.port}" not in str(answer)
    assert field.memory() < before + (100 << 20)
