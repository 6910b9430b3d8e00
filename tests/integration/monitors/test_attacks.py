"""Monitors come and go, and a relay dies, under a flood: only what was dropped is missing, in order."""

import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.channel.admin import (
    A,
    AdminRequest,
    MonitorLoad,
    MonitorRemove,
    MonitorsWanted,
    MonitorSwitch,
    StatusWanted,
)
from appliance.channel.answers.monitor_answers import Replaced
from appliance.cli.admin_client import AdminSocket
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession, has_ros
from tests.support.processes import Event, Process
from tests.support.requirements import needs
from tests.support.waiting import eventually

ROUNDS = 25  # of four changes each


def tag(version: int) -> str:
    """Puts its version behind what goes through /flood, and drops nothing."""
    return (
        "tag() { event said(std::string text) /flood std_msgs/String '{data:text}'"
        f' {{ text = text + " v{version}"; }} }}'
    )


def beside(version: int) -> str:
    """A monitor of another topic and of the latched one, which it changes."""
    return (
        "beside() { event other(std::string text) /elsewhere std_msgs/String '{data:text}' { }"
        f" event map(std::string text) /map std_msgs/String '{{data:text}}' {{ text = text + \" m{version}\"; }} }}"
    )


@pytest.fixture
def appliance() -> Iterator[Appliance]:
    """Two relays and no monitors."""
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
    with Appliance(options=("--api", "off"), relays=2) as appliance:
        yield appliance


@pytest.fixture
def ros(appliance: Appliance, tmp_path: Path) -> Iterator[RosSession]:
    """Nodes of one test."""
    with RosSession(appliance.master_uri, tmp_path) as session:
        yield session


def ask(appliance: Appliance, request: AdminRequest[A]) -> A:
    """What a verb of `rosrv` asks, without starting a process for each."""
    answer = AdminSocket(appliance.state).ask(request)
    assert answer.ok, answer.error
    return answer.given()


def relays(appliance: Appliance) -> list[int]:
    """The process ids of the relays; `rosrv status` fails while one is away."""
    processes = ask(appliance, StatusWanted()).processes
    return [row.pid for row in processes if row.role == "relay"]


def load(appliance: Appliance, **files: str) -> Replaced:
    """Load or replace files of these names."""
    return ask(appliance, MonitorLoad({f"{name}.rv": text for name, text in files.items()}, {}))


def counted(listener: Process) -> Event:
    """What a counting listener has had so far."""
    since = listener.mark()
    listener.send("")
    return listener.wait_for(event="counted", since=since)


def caught_up(listener: Process, last: int) -> Event:
    """The same, when the last message has come."""
    eventually(lambda: counted(listener)["last"] == last, f"message {last}", seconds=90)
    return counted(listener)


def missing(count: Event) -> int:
    """How many messages did not come between the first and the last."""
    return sum(after - before - 1 for before, after in count["gaps"])


def versions(count: Event) -> list[int]:
    """The versions of the monitor that messages went through, as they changed; 0 without it."""
    return [int(word.removeprefix("v")) if word else 0 for word, _number in count["words"]]


def change(appliance: Appliance, number: int) -> None:
    """Four changes: replaced, switched off, switched on, and another one loaded or removed."""
    load(appliance, tag=tag(number))
    ask(appliance, MonitorSwitch(["tag"], False))
    ask(appliance, MonitorSwitch(["tag"], True))
    if number % 2:
        load(appliance, beside=beside(number))
    else:
        ask(appliance, MonitorRemove(["beside"]))


def test_a_hundred_changes_under_a_flood_with_a_slow_a_stopped_and_a_late_listener(
    appliance: Appliance, ros: RosSession
) -> None:
    """Who keeps up gets everything in order; what the others lack is what was counted as dropped."""
    ros.talker("roscpp", "/map", "--latch", name="map")
    early = ros.listener("roscpp", "/map")
    early.wait_for(event="received", data="hello 1")
    talker = ros.node("rospy", "flood_talker", "/flood", name="flood")
    fast = ros.node("rospy", "counting_listener", "/flood", name="fast")
    stopped = ros.node("rospy", "counting_listener", "/flood", name="stopped")
    for listener in (fast, stopped):
        listener.wait_for(event="first")
    stopped.popen.send_signal(signal.SIGSTOP)
    eventually(
        lambda: ask(appliance, StatusWanted()).dropped > 0, "the stopped one's queue is full", seconds=90
    )
    slow = ros.node("rospy", "counting_listener", "/flood", "--slow", "0.002", name="slow")
    slow.wait_for(event="first")
    late: Process | None = None
    for number in range(1, ROUNDS + 1):
        change(appliance, number)
        if number == ROUNDS // 2:
            late = ros.node("rospy", "counting_listener", "/flood", name="late")
    assert late is not None
    stopped.popen.send_signal(signal.SIGCONT)
    talker.send("")
    last = int(talker.wait_for(event="flooded")["last"])
    counts = {one: caught_up(one, last) for one in (fast, late, slow, stopped)}
    for listener, count in counts.items():
        assert not count["backwards"], listener.story()
    for listener in (fast, late):
        assert counts[listener]["gaps"] == []
        assert counts[listener]["came"] == last - counts[listener]["first"] + 1
    seen = [version for version in versions(counts[fast]) if version]
    assert seen == sorted(seen)
    assert seen[-1] == ROUNDS
    lost = missing(counts[slow]) + missing(counts[stopped])
    eventually(
        lambda: ask(appliance, StatusWanted()).dropped == lost, f"{lost} messages are counted as dropped"
    )
    assert missing(counts[stopped]) > 0
    heard = ros.listener("rospy", "/map").wait_for(event="received")
    assert heard["data"] == "hello 1"  # it was relayed before there was a monitor
    assert len(early.seen(event="received")) == 1


def test_a_relay_that_is_killed_while_specifications_are_loaded(
    appliance: Appliance, ros: RosSession
) -> None:
    """The load is refused or done, nothing in between: what is said to be in force is, on both relays, afterwards."""
    talker = ros.node("rospy", "flood_talker", "/flood", "--rate", "100", "--bytes", "10", name="flood")
    listener = ros.node("rospy", "counting_listener", "/flood", name="ear")
    load(appliance, tag=tag(1))
    listener.wait_for(event="first")
    in_force = 1
    for number in range(2, 6):
        answers: list[Any] = []

        def load_it(number: int = number, answers: list[Any] = answers) -> None:
            files = {"tag.rv": tag(number), "beside.rv": beside(number)}
            answers.append(AdminSocket(appliance.state).ask(MonitorLoad(files, {})))

        victim = relays(appliance)[number % 2]
        loading = threading.Thread(target=load_it)
        loading.start()
        loading.join(0.05 * (number - 2))  # at another moment of the load each time
        os.kill(victim, signal.SIGKILL)
        loading.join()
        if answers[0].ok:
            in_force = number
        else:
            assert "try again" in answers[0].error + " ".join(answers[0].findings)
        eventually(lambda: len(relays(appliance)) == 2, "both relays run")
        before = counted(listener)["last"]

        def settled(before: int = before, version: int = in_force) -> bool:
            count = counted(listener)
            return int(count["last"]) > before + 50 and versions(count)[-1] == version

        eventually(settled, f"messages go on, through version {in_force}")
    load(appliance, tag=tag(9))
    eventually(lambda: versions(counted(listener))[-1] == 9, "the next load is in force")
    assert ask(appliance, MonitorsWanted()).refused == []
    talker.send("")
