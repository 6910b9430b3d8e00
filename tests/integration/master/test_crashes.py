"""Processes are killed or stopped, and policies reloaded under load: every confirmed call takes full effect."""

import contextlib
import json
import os
import signal
import subprocess
import threading
import xmlrpc.client
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.channel.admin import PolicyReload
from appliance.cli.connection.admin_client import AdminSocket
from tests.support.appliance import OPEN_POLICY
from tests.support.field import Field, Impostor, answering
from tests.support.processes import LIMIT
from tests.support.waiting import eventually

POLICY = OPEN_POLICY
BURST = 60


class Burst:
    """Register one node after another from the robot, each with a topic and a parameter, as fast as possible."""

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
        """Unregister all nodes: later, control would find them dead, and unregister them during another test."""
        with xmlrpc.client.ServerProxy(self._field.master) as server:
            calls: Any = xmlrpc.client.MultiCall(server)
            for name in self.registered:
                calls.unregisterPublisher(name, f"/b{name}", self.node.uri)
            assert [answer[0] for answer in calls()] == [1] * len(self.registered)

    def finish(self) -> None:
        """Wait until all registrations are done."""
        for thread in self._threads:
            thread.join(LIMIT)
            assert not thread.is_alive()

    def all_there(self) -> None:
        """Assert that every confirmed node is registered with its parameter, and that no call was refused."""
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
    """Provide the field; afterwards messages arrive again (some may be lost), and a new node can join."""
    yield battlefield
    battlefield.listener.wait_for(event="received", since=battlefield.listener.mark())
    late = battlefield.ros.on(battlefield.ocu).listener("rospy", "/chatter")
    late.wait_for(event="received", publisher="/voice")
    late.stop()


def published(field: Field, port: int, control: int) -> list[str]:
    """Return the topics that have a publisher at the ROS master, which answers only to the user of control."""
    ask = "import sys, xmlrpc.client as x; print(*dict(x.ServerProxy(sys.argv[1]).getSystemState('/looker')[2][0]))"
    command = ["/usr/bin/python3", "-c", ask, f"http://127.0.0.1:{port}"]
    user = Path(f"/proc/{control}").stat().st_uid
    done = field.middle.run(
        lambda: subprocess.run(command, user=user, cwd="/", stdout=subprocess.PIPE, text=True, check=True)
    )
    return str(done.stdout).split()


def has_unread(port: int) -> bool:
    """Whether a connection to a port of this namespace has bytes that its program has not read."""
    rows = map(str.split, Path("/proc/thread-self/net/tcp").read_text(encoding="ascii").splitlines()[1:])
    queues = [row[4] for row in rows if row[1].endswith(f":{port:04X}") and row[3] == "01"]
    return any(int(queue.split(":")[1], 16) for queue in queues)


def test_control_killed_between_answer_and_forwarding(working: Field) -> None:
    """The ROS master hangs and nodes are answered: after the death of control, it gets what was answered."""
    appliance, robot = working.appliance, working.robot
    rosmaster = appliance.pids("rosmaster")[0]
    with Impostor(robot, answering([1, "", 4711])) as node:

        def registered(method: str, topic: str) -> None:
            kind = ["std_msgs/String"] if method == "registerPublisher" else []
            answer = working.call(robot, method, "/answered", topic, *kind, node.uri)
            assert answer[0] == 1, answer

        port = json.loads((appliance.state / "run" / "config.json").read_text())["rosmaster_port"]
        control = appliance.pids("control")[0]
        registered("registerPublisher", "/ended")
        eventually(lambda: "/ended" in published(working, port, control), "the ROS master has it")
        known = len(appliance.audit("--event", "reconciled"))
        os.kill(rosmaster, signal.SIGSTOP)
        try:
            registered("registerPublisher", "/under_way")
            # From here on control waits for an answer, and sends nothing else.
            eventually(lambda: working.middle.run(lambda: has_unread(port)), "the ROS master would get it")
            registered("registerPublisher", "/answered_only")
            registered("unregisterPublisher", "/ended")
            os.kill(control, signal.SIGKILL)
        finally:
            os.kill(rosmaster, signal.SIGCONT)
        records = appliance.recorded("--event", "reconciled", count=known + 1)
        detail = max(records, key=lambda record: record["sequence"])["detail"]
        assert (detail["made"] >= 1, detail["settled"]) == (True, 1), detail
        publishers = dict(map(tuple, working.call(robot, "getSystemState", "/looker")[2][0]))
        assert [publishers.get(topic) for topic in ("/under_way", "/answered_only", "/ended")] == [
            ["/answered"],
            ["/answered"],
            None,
        ]
        working.call(robot, "setParam", "/looker", "/round", 1)  # it waits for the end of the round
        appliance.kill("control")
        working.call(robot, "setParam", "/looker", "/round", 2)
        registered("registerPublisher", "/ended")
        appliance.recorded("--event", "registered", count=2, resource="/ended")
        assert (
            len(appliance.audit("--event", "reconciled")) == known + 1
        )  # the second round found no difference


@pytest.mark.parametrize("role", ["control", "rosmaster", "relay"])
def test_killed_in_a_burst_of_registrations(working: Field, role: str) -> None:
    """`kill -9` during many registrations: each confirmed registration survives, and none fails."""
    pid = working.appliance.pids(role)[0]
    with Burst(working, f"/burst_{role}") as burst:
        os.kill(pid, signal.SIGKILL)
        burst.finish()
        burst.all_there()


def test_both_killed_at_once(working: Field) -> None:
    """Control and `rosmaster` die together: confirmed registrations are restored from disk."""
    pids = [working.appliance.pids(role)[0] for role in ("rosmaster", "control")]
    with Burst(working, "/burst_both") as burst:
        for pid in pids:
            os.kill(pid, signal.SIGKILL)
        burst.finish()
        burst.all_there()


def test_rosmaster_killed_with_a_full_queue(working: Field) -> None:
    """Calls are answered until the host's share of changes waits for the ROS master; a new one gets all of them."""
    wanted = [f"/full/topic_{number}" for number in range(1600)]
    rosmaster = working.appliance.pids("rosmaster")[0]
    answers: list[Any] = []
    with Impostor(working.robot, answering([1, "", 4711])) as node:

        def register() -> None:
            with xmlrpc.client.ServerProxy(working.master) as server:
                for start in range(0, len(wanted), 50):
                    calls: Any = xmlrpc.client.MultiCall(server)
                    for topic in wanted[start : start + 50]:
                        calls.registerPublisher("/full", topic, "std_msgs/String", node.uri)
                    answers.extend(calls())

        registering = threading.Thread(target=working.robot.run, args=(register,), daemon=True)
        os.kill(rosmaster, signal.SIGSTOP)
        registering.start()
        eventually(lambda: len(answers) >= 500, "five hundred calls are answered")
        assert registering.is_alive()
        os.kill(rosmaster, signal.SIGKILL)
        registering.join(LIMIT)
        assert [answer[0] for answer in answers] == [1] * len(wanted)
        working.appliance.recorded("--event", "reconciled")
        publishers = dict(map(tuple, working.call(working.robot, "getSystemState", "/looker")[2][0]))
        assert [topic for topic in wanted if publishers.get(topic) != ["/full"]] == []


def test_rosmaster_stopped_for_two_seconds(working: Field) -> None:
    """A stopped `rosmaster` delays writes of parameters; no call fails, and it is not killed."""
    pid = working.appliance.pids("rosmaster")[0]
    with Burst(working, "/burst_stopped") as burst:
        os.kill(pid, signal.SIGSTOP)
        goes_on = threading.Timer(2, os.kill, (pid, signal.SIGCONT))
        goes_on.start()
        working.listener.wait_for_count(  # messages do not need `rosmaster`
            len(working.listener.seen(event="received")) + 50, event="received"
        )
        goes_on.join()
        burst.finish()
        burst.all_there()
    assert working.appliance.pids("rosmaster") == [pid]


def test_reloads_under_load(working: Field) -> None:
    """Two hundred reloads, some invalid, while nodes register: each call is decided by one complete policy."""
    even = POLICY.replace("[Subscribers]", "[Subscribers]\n/even_topic = 10.77.0.66")
    odd = POLICY.replace("[Publishers]", "[Publishers]\n/odd_topic = 10.77.0.66")
    over = threading.Event()
    odd_answers: list[Any] = []

    def keep_asking() -> None:
        while not over.is_set():
            with contextlib.suppress(OSError), xmlrpc.client.ServerProxy(working.master) as server:
                odd_answers.append(
                    server.registerPublisher(
                        "/odd_one", "/odd_topic", "std_msgs/String", "http://10.77.0.20:40404/"
                    )
                )
                server.unregisterPublisher("/odd_one", "/odd_topic", "http://10.77.0.20:40404/")

    asking = threading.Thread(target=working.ocu.run, args=(keep_asking,), daemon=True)
    asking.start()
    with Burst(working, "/burst_reload", 120) as burst:
        for _ in range(67):
            for text, fine in ((even, True), (odd, True), (odd + "nonsense\n[", False)):
                working.appliance.policy_file.write_text(text)
                answer = AdminSocket(working.appliance.state).ask(PolicyReload())
                assert answer.ok is fine, answer
        burst.finish()
        over.set()
        asking.join(LIMIT)
        burst.all_there()
    granted = [one for one in odd_answers if one[0] == 1]
    denied = [one for one in odd_answers if one[0] != 1]
    assert granted
    assert denied
    assert all("[Publishers] /odd_topic" in one[1] for one in denied), denied[:3]
    working.appliance.reload(POLICY)


def test_the_whole_appliance_restarts(battlefield: Field) -> None:
    """After `rosrv up` on the same state, running nodes continue with their parameters and are not restarted."""
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
