"""Floods from a rogue host to which the policy grants everything, so that only limits protect the other hosts."""

import contextlib
import threading
import time
import xmlrpc.client
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.support.appliance import OPEN_POLICY
from tests.support.field import Field, Impostor, whole
from tests.support.processes import LIMIT
from tests.support.waiting import allowed, eventually

POLICY = OPEN_POLICY
CONFIGURATION = (
    "limits: {topics_per_host: 1000}\n"  # lower than by default, to reach the limit within seconds
)
HOST = "10.77.0.66"
SLOW = 1.0  # seconds for one call of the victim during a flood, on an idle machine
GROWTH = 160 << 20  # bytes that control may grow by under attack: buffers within their limits


def request(method: str, *parameters: Any) -> bytes:
    body = xmlrpc.client.dumps(parameters, method).encode()
    return b"POST / HTTP/1.1\r\nHost: m\r\nContent-Length: %d\r\n\r\n" % len(body) + body


class Flood:
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
    eventually(lambda: field.memory(role) < most, f"{role} keeps less than {most >> 20} MiB")


@pytest.fixture
def calm(field: Field) -> Iterator[Field]:
    before = {role: field.memory(role) for role in ("control", "relay")}
    pids = {role: field.appliance.pids(role) for role in ("control", "relay", "rosmaster")}
    yield field
    assert {role: field.appliance.pids(role) for role in pids} == pids, "a process was restarted"
    for role, size in before.items():
        settled(field, role, size + GROWTH)
    field.ros.on(field.ocu).listener("rospy", "/chatter").wait_for(event="received")


def test_calls(calm: Field) -> None:
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


def test_calls_of_a_node_that_never_answers(calm: Field) -> None:
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


def test_subscribers_that_never_answer_delay_no_list_of_others(calm: Field) -> None:
    """Each of 300 has a list of publishers to get for each change; the operator's listener hears of it in seconds."""
    silence = threading.Event()
    deaf = [f"/deaf_{number}" for number in range(300)]
    with Impostor(calm.attacker, lambda _connection, _request: silence.wait(30)) as node:
        for name in deaf:
            assert calm.rogue("registerSubscriber", name, "/told", "std_msgs/String", node.uri)[0] == 1
        listener = calm.ros.on(calm.ocu).listener("rospy", "/told")
        for number in range(3):
            talker = calm.ros.talker("roscpp", "/told", name=f"late_{number}")
            began = time.monotonic()
            listener.wait_for(event="received", publisher=f"/late_{number}")
            assert time.monotonic() - began < allowed(2 * SLOW)
            talker.stop()
        assert node.called.is_set()
        calm.unharmed(20)
        silence.set()
        for name in deaf:
            calm.rogue("unregisterSubscriber", name, "/told", node.uri)


def test_queried_names_do_not_accumulate(calm: Field) -> None:
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
