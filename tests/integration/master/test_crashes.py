import contextlib
import os
import signal
import socket
import threading
import xmlrpc.client
from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.appliance import OPEN_POLICY
from tests.support.field import Field, Impostor, answering
from tests.support.processes import LIMIT

POLICY = OPEN_POLICY
BURST = 60


class Burst:
    def __init__(self, field: Field, name: str, count: int = BURST) -> None:
        self._field, self._name, self._count = field, name, count
        self.node = Impostor(field.robot, answering([1, "", 4711]))
        self.registered: list[str] = []
        self.failed: list[Any] = []
        self.half = threading.Event()
        self._over = threading.Event()
        self._threads = [
            threading.Thread(
                target=field.robot.run, args=(lambda start=start: self._register(start),), daemon=True
            )
            for start in range(4)
        ]

    def _register(self, start: int) -> None:
        for number in range(start, self._count, 4):
            name = f"{self._name}_{number}"
            while not self._over.is_set():  # retry after a broken connection, as the client libraries do
                with contextlib.suppress(OSError, xmlrpc.client.ProtocolError):
                    with xmlrpc.client.ServerProxy(self._field.master) as server:
                        answer: Any = server.registerPublisher(
                            name, f"/b{name}", "std_msgs/String", self.node.uri
                        )
                        server.setParam(name, f"/burst{name}", number)
                    break
            else:
                return
            (self.registered if answer[0] == 1 else self.failed).append(name if answer[0] == 1 else answer)
            if len(self.registered) * 2 > self._count:
                self.half.set()

    def __enter__(self) -> "Burst":
        for thread in self._threads:
            thread.start()
        assert self.half.wait(LIMIT)
        return self

    def __exit__(self, *exc: object) -> None:
        self._over.set()
        self.finish()
        if exc[0] is None:
            self._field.robot.run(self._unregister)
        self.node.__exit__(*exc)

    def _unregister(self) -> None:
        """Unregister the nodes: control would otherwise find them dead during another test."""
        with xmlrpc.client.ServerProxy(self._field.master) as server:
            calls: Any = xmlrpc.client.MultiCall(server)
            for name in self.registered:
                calls.unregisterPublisher(name, f"/b{name}", self.node.uri)
            assert [answer[0] for answer in calls()] == [1] * len(self.registered)

    def finish(self) -> None:
        for thread in self._threads:
            thread.join(LIMIT)
            assert not thread.is_alive()

    def all_there(self) -> None:
        assert not self.failed, self.failed[:3]
        assert len(self.registered) == self._count
        state = self._field.call(self._field.robot, "getSystemState", "/looker")[2]
        publishers = dict(map(tuple, state[0]))
        missing = [name for name in self.registered if publishers.get(f"/b{name}") != [name]]
        assert not missing
        values = self._field.call(self._field.robot, "getParam", "/looker", "/burst")[2]
        assert {f"/{key}" for key in values} >= set(self.registered)


@pytest.fixture
def working(battlefield: Field) -> Iterator[Field]:
    yield battlefield
    battlefield.listener.wait_for(event="received", since=battlefield.listener.mark())
    late = battlefield.ros.on(battlefield.ocu).listener("rospy", "/chatter")
    late.wait_for(event="received", publisher="/voice")
    late.stop()


@pytest.mark.parametrize("roles", [["control"], ["rosmaster"], ["relay"], ["rosmaster", "control"]])
def test_killed_in_a_burst_of_registrations(working: Field, roles: list[str]) -> None:
    pids = [working.appliance.pids(role)[0] for role in roles]
    with Burst(working, f"/burst_{'_'.join(roles)}") as burst:
        for pid in pids:
            os.kill(pid, signal.SIGKILL)
        burst.finish()
        burst.all_there()


def test_the_whole_appliance_restarts(battlefield: Field) -> None:
    field = battlefield
    ears = [
        field.ros.on(field.ocu).listener("rospy", "/chatter", name="python_ear"),
        field.ros.on(field.ocu).listener("roscpp", "/chatter", name="cpp_ear"),
    ]
    for heard in ears:
        heard.wait_for(event="received")
    with Burst(field, "/burst_restart", 20) as burst:
        burst.finish()
        field.call(field.robot, "setParam", "/looker", "/kept/over", {"a": [1, 2.5, "x"]})
        field.appliance.stop()
        before = [heard.mark() for heard in ears]
        field.appliance.start()
        for heard, mark in zip(ears, before, strict=True):
            heard.wait_for(event="received", since=mark)
        burst.all_there()
        assert field.call(field.robot, "getParam", "/looker", "/kept/over")[2] == {"a": [1, 2.5, "x"]}
        nodes = field.ros.run("rosnode", "list").stdout.split()
        assert {"/voice", "/ear", "/python_ear", "/cpp_ear", "/burst_restart_0"} <= set(nodes)


def test_another_program_took_a_nodes_port_while_the_appliance_was_off(battlefield: Field) -> None:
    field = battlefield
    heard = field.ros.on(field.ocu).listener("roscpp", "/chatter")
    heard.wait_for(event="received", publisher="/voice")
    uri = field.call(field.robot, "lookupNode", "/looker", "/voice")[2]
    field.appliance.stop()
    mark, port = heard.mark(), int(uri.rpartition(":")[2].rstrip("/"))
    with field.middle.run(lambda: socket.create_server(("", port))):
        field.appliance.start()
        heard.wait_for(event="received", publisher="/voice", since=mark)
        assert field.call(field.robot, "lookupNode", "/looker", "/voice")[2] not in {uri, ""}
