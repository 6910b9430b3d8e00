import os
import signal
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from appliance.channel.admin import (
    MonitorLoad,
    MonitorRemove,
    MonitorsWanted,
    MonitorSwitch,
    StatusWanted,
)
from appliance.channel.answers.monitor_answers import Replaced
from appliance.cli.connection.admin_client import AdminSocket
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession, need_ros
from tests.support.processes import Event, Process
from tests.support.waiting import eventually

ROUNDS = 25  # four changes in each round


def tag(version: int) -> str:
    return (
        "tag() { event said(std::string text) /flood std_msgs/String '{data:text}'"
        f' {{ text = text + " v{version}"; }} }}'
    )


def beside(version: int) -> str:
    return (
        "beside() { event other(std::string text) /elsewhere std_msgs/String '{data:text}' { }"
        f" event map(std::string text) /map std_msgs/String '{{data:text}}' {{ text = text + \" m{version}\"; }} }}"
    )


@pytest.fixture
def appliance() -> Iterator[Appliance]:
    need_ros()
    with Appliance(options=("--api", "off"), relays=2) as appliance:
        yield appliance


def relays(appliance: Appliance) -> list[int]:
    processes = appliance.ask(StatusWanted()).processes
    return [row.pid for row in processes if row.role == "relay"]


def load(appliance: Appliance, **files: str) -> Replaced:
    return appliance.ask(MonitorLoad({f"{name}.rv": text for name, text in files.items()}, {}))


def counted(listener: Process) -> Event:
    since = listener.mark()
    listener.send("")
    return listener.wait_for(event="counted", since=since)


def caught_up(listener: Process, last: int) -> Event:
    eventually(lambda: counted(listener)["last"] == last, f"message {last}", seconds=90)
    return counted(listener)


def missing(count: Event) -> int:
    return sum(after - before - 1 for before, after in count["gaps"])


def versions(count: Event) -> list[int]:
    return [int(word.removeprefix("v")) if word else 0 for word, _number in count["words"]]


def change(appliance: Appliance, number: int) -> None:
    load(appliance, tag=tag(number))
    appliance.ask(MonitorSwitch(["tag"], False))
    appliance.ask(MonitorSwitch(["tag"], True))
    if number % 2:
        load(appliance, beside=beside(number))
    else:
        appliance.ask(MonitorRemove(["beside"]))


def test_monitor_changes_under_a_flood_lose_only_counted_messages(
    appliance: Appliance, ros: RosSession
) -> None:
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
        lambda: appliance.ask(StatusWanted()).dropped > 0, "the stopped one's queue is full", seconds=90
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
        lambda: appliance.ask(StatusWanted()).dropped == lost, f"{lost} messages are counted as dropped"
    )
    assert missing(counts[stopped]) > 0
    heard = ros.listener("rospy", "/map").wait_for(event="received")
    assert heard["data"] == "hello 1"  # relayed before there was a monitor
    assert len(early.seen(event="received")) == 1


def test_a_relay_killed_while_specifications_are_loaded(appliance: Appliance, ros: RosSession) -> None:
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
        loading.join(0.05 * (number - 2))  # at a different time of the load in each round
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
    assert appliance.ask(MonitorsWanted()).refused == []
    talker.send("")
