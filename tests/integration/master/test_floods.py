"""Floods of connections, calls, registrations, names, permissions and values; other hosts hardly notice them.

The policy grants the rogue everything, so limits, and not rules, protect the other hosts.
"""

import contextlib
import socket
import threading
import time
import xmlrpc.client
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from appliance.quotas.table import RVMASTER_CONNECTIONS
from tests.support.appliance import OPEN_POLICY
from tests.support.field import Field, Impostor, answering, whole
from tests.support.processes import LIMIT
from tests.support.rosmaster import master_at
from tests.support.waiting import allowed, eventually

POLICY = OPEN_POLICY
CONFIGURATION = (
    "limits: {topics_per_host: 1000}\n"  # lower than by default, to reach the limit within seconds
)
HOST = "10.77.0.66"
SLOW = 1.0  # seconds for one call of the victim during a flood, on an idle machine
GROWTH = 160 << 20  # bytes that control may grow by under attack: buffers within their limits


def request(method: str, *parameters: Any) -> bytes:
    """Return a call as bytes."""
    body = xmlrpc.client.dumps(parameters, method).encode()
    return b"POST / HTTP/1.1\r\nHost: m\r\nContent-Length: %d\r\n\r\n" % len(body) + body


class Flood:
    """Threads that repeat an action until the block ends."""

    def __init__(self, field: Field, threads: int, act: Callable[[int, int], None]) -> None:
        self._over = threading.Event()
        self.count = 0
        self._threads = [
            threading.Thread(target=field.attacker.run, args=(lambda number=number: self._run(act, number),))
            for number in range(threads)
        ]

    def _run(self, act: Callable[[int, int], None], number: int) -> None:
        turn = 0
        while not self._over.is_set():
            with contextlib.suppress(OSError, xmlrpc.client.Error):
                act(number, turn)
            self.count += 1
            turn += 1

    def __enter__(self) -> "Flood":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join(LIMIT)
        assert not any(thread.is_alive() for thread in self._threads), "the flood is still running"


def bystander(field: Field, calls: int = 30) -> float:
    """Return the slowest of the victim's calls: to RVMaster, each on its own connection, and to a node's endpoint."""
    slowest = 0.0
    face = field.call(field.robot, "lookupNode", "/looker", "/voice")[2]
    for number in range(calls):
        begun = time.monotonic()
        if number % 2:
            code, why, _ = field.call(field.robot, "getParam", "/looker", "/rosdistro")
            assert code == 1, why
        else:
            assert field.call(field.robot, "getName", "/looker", uri=face)[2] == "/voice"
        slowest = max(slowest, time.monotonic() - begun)
    return slowest


def settled(field: Field, role: str, most: int) -> None:
    """Wait until the memory of a flood is released; requests in progress at the flood's end are still carried out."""
    eventually(lambda: field.memory(role) < most, f"{role} keeps less than {most >> 20} MiB")


@pytest.fixture
def calm(field: Field) -> Iterator[Field]:
    """Assert that the memory of control and relay does not grow, and that nodes can still register."""
    before = {role: field.memory(role) for role in ("control", "relay")}
    pids = {role: field.appliance.pids(role) for role in ("control", "relay", "rosmaster")}
    yield field
    assert {role: field.appliance.pids(role) for role in pids} == pids, "a process was restarted"
    for role, size in before.items():
        settled(field, role, size + GROWTH)
    field.ros.on(field.ocu).listener("rospy", "/chatter").wait_for(event="received")


def test_connections(calm: Field) -> None:
    """A host has a quota of connections; further ones are closed, and another host connects at once."""
    with contextlib.ExitStack() as held:
        opened = [held.enter_context(calm.connect()) for _ in range(700)]
        for one in opened:
            one.setblocking(False)

        def closed() -> int:
            return sum(map(is_closed, opened))

        eventually(
            lambda: closed() >= 700 - RVMASTER_CONNECTIONS.bounds.unknown, lambda: f"{closed()} closed"
        )
        assert bystander(calm) < allowed(SLOW)


def is_closed(sock: socket.socket) -> bool:
    """Whether the peer has closed the connection."""
    try:
        return sock.recv(1, socket.MSG_PEEK) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


def test_calls(calm: Field) -> None:
    """Flood with calls as fast as a host can make them, on persistent connections."""
    data = request("getSystemState", "/flooder")

    def act(_number: int, _turn: int) -> None:
        with calm.connect() as sock:
            for _ in range(100):
                sock.sendall(data)
                received = b""
                while not whole(received):
                    more = sock.recv(65536)
                    if not more:
                        return
                    received += more

    with Flood(calm, 16, act) as flood:
        assert bystander(calm) < allowed(SLOW)
        calm.unharmed(50)
    assert flood.count > 0


def test_calls_whose_answers_are_not_read(calm: Field) -> None:
    """Requests without reading the answers, on many connections, are limited and finally closed."""
    data = request("getParam", "/flooder", "/") * 200
    held = [calm.connect() for _ in range(100)]
    for one in held:
        one.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                one.send(data)
    assert bystander(calm) < allowed(SLOW)
    for one in held:
        one.close()


def test_connections_closed_before_the_answer(calm: Field) -> None:
    """Clients repeatedly disconnect before the answer."""
    data = request("getSystemState", "/flooder")

    def act(_number: int, _turn: int) -> None:
        with calm.connect() as sock:
            sock.sendall(data)

    with Flood(calm, 8, act):
        assert bystander(calm) < allowed(SLOW)
        calm.unharmed(50)


def test_bodies_that_never_end(calm: Field) -> None:
    """Large incomplete bodies are limited per host, whatever their number."""
    beginning = b"POST / HTTP/1.1\r\nContent-Length: 16000000\r\n\r\n" + b"x" * 15_000_000
    held = []
    for _ in range(20):
        sock = calm.connect()
        held.append(sock)
        sock.settimeout(2)
        with contextlib.suppress(OSError):
            sock.sendall(beginning)
    record = calm.recorded("bytes in requests and answers", host=HOST)
    assert record["decision"] == "deny"
    assert bystander(calm) < allowed(SLOW)
    for one in held:
        one.close()


def test_calls_of_a_node_that_never_answers(calm: Field) -> None:
    """Slow requests that query the rogue's own node do not occupy the slots of other hosts."""
    silence = threading.Event()
    with Impostor(calm.attacker, lambda _connection, _request: silence.wait(20)) as node:
        answer = calm.rogue("registerPublisher", "/black_hole", "/hole", "std_msgs/String", node.uri)
        assert answer[0] == 1
        face = calm.rogue("lookupNode", "/looker", "/black_hole")[2]
        port = int(face.rsplit(":", 1)[1].rstrip("/"))
        data = request("getPid", "/asker")
        held = [calm.connect(port=port) for _ in range(200)]
        for one in held:
            one.sendall(data)
        assert node.called.wait(LIMIT)
        assert bystander(calm) < allowed(SLOW)
        calm.unharmed(50)
        for one in held:
            one.close()
        silence.set()


def test_values_for_a_node_that_never_answers(calm: Field) -> None:
    """Updates of a large parameter for a node that reads none do not accumulate in memory."""
    silence = threading.Event()
    with Impostor(calm.attacker, lambda _connection, _request: silence.wait(20)) as node:
        assert calm.rogue("subscribeParam", "/hoarder", node.uri, "/hoard")[0] == 1
        for number in range(30):  # together more than GROWTH
            assert calm.rogue("setParam", "/setter", "/hoard", {"k": "x" * 7_000_000, "n": number})[0] == 1
        assert bystander(calm) < allowed(SLOW)
        silence.set()
    assert calm.rogue("deleteParam", "/setter", "/hoard")[0] == 1


def test_registrations(calm: Field) -> None:
    """The rogue reaches its limit of nodes and topics, and keeps it in later tests; other hosts still get both.

    The rogue's nodes answer: silent nodes would be lost, and make room for the next.
    """
    refused: list[Any] = []
    with Impostor(calm.attacker, answering([1, "", 4711])) as node:

        def act(number: int, turn: int) -> None:
            name = f"/many_{number}_{turn}"
            with master_at(calm.master) as server:
                answer = server.registerPublisher(name, f"/t{name[1:]}", "std_msgs/String", node.uri)
            if answer[0] != 1:
                refused.append(answer)

        def at_its_limit() -> list[Any]:
            bystander(calm, 4)
            return refused

        with Flood(calm, 4, act):
            eventually(at_its_limit, "the limit of one host is reached", 4 * LIMIT)
    calm.denied(refused[0], "500 nodes, the limit for one host")
    calm.ros.talker("rospy", "/new_topic", name="newcomer")
    calm.ros.on(calm.ocu).listener("rospy", "/new_topic", name="new_ear").wait_for(event="received")


def test_registrations_of_one_node(calm: Field) -> None:
    """Topics of one node count as well."""
    answer: list[Any] = [1]
    with Impostor(calm.unknown_host, answering([1, "", 0])) as node:
        for number in range(20):
            parts = [
                {
                    "methodName": "registerPublisher",
                    "params": ["/one", f"/topics/t{number}_{inner}", "std_msgs/String", node.uri],
                }
                for inner in range(100)
            ]
            answer = calm.call(calm.unknown_host, "system.multicall", parts)[-1][0]
            if answer[0] != 1:
                break
    assert "1000 registrations, the limit for one host" in answer[1]


def test_queried_names_do_not_accumulate(calm: Field) -> None:
    """New names in reading calls and topic requests, without end, do not make memory grow."""
    face = calm.rogue("lookupNode", "/looker", "/voice")[2]

    def act(number: int, turn: int) -> None:
        with xmlrpc.client.ServerProxy(face) as node:
            for inner in range(50):
                node.requestTopic(f"/asker_{number}_{turn}_{inner}", "/chatter", [["TCPROS"]])
        with xmlrpc.client.ServerProxy(calm.master) as server:
            for inner in range(50):
                server.lookupNode(f"/asker_{number}_{turn}_{inner}", f"/nobody_{number}_{turn}_{inner}")

    with Flood(calm, 4, act):
        calm.unharmed(50)
        assert bystander(calm) < allowed(SLOW)


def test_denials(calm: Field) -> None:
    """Thousands of denials are folded into a few records with counts."""
    parts = [{"methodName": f"noSuch{number}", "params": ["/denied"]} for number in range(5000)]
    calm.rogue("system.multicall", parts)
    calm.recorded(event="denials folded", host=HOST)
    written = [event for event in calm.trail.seen(host=HOST, decision="deny") if "noSuch" in event["reason"]]
    assert len(written) < 1000
    assert bystander(calm) < allowed(SLOW)


def test_relay_ports(calm: Field) -> None:
    """Connections to a relay port without a header do not keep subscribers away."""
    face = calm.rogue("lookupNode", "/looker", "/voice")[2]
    port = calm.rogue("requestTopic", "/knocker", "/chatter", [["TCPROS"]], uri=face)[2][2]
    held = []
    with contextlib.suppress(OSError):
        for _ in range(600):
            held.append(calm.attacker.run(lambda: socket.create_connection(("10.77.0.2", port), 1)))
    calm.ros.on(calm.ocu).listener("roscpp", "/chatter").wait_for(event="received")
    for one in held:
        one.close()
