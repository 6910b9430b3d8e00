import json
import os
import signal
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any
from xmlrpc.client import ServerProxy

import pytest

from tests.support.appliance import Appliance
from tests.support.nodes import Client, RosSession, need_ros, numbers, without_gap
from tests.support.processes import Process
from tests.support.site import Masters
from tests.support.waiting import eventually

CLIENTS: list[Client] = ["rospy", "roscpp"]
SPECIFICATION = """
begin NAME() {
    int heard = 0;
    std_msgs::String report;
    event said(std::string text) /TOPIC std_msgs/String '{data:text}' {
        heard = heard + 1;
        text = "NAME " + std::to_string(heard) + " " + text;
        if (heard == 3) { report.data = "three on TOPIC"; PUBLISH(/NAME/alarm, std_msgs/String, report); }
    }
}
"""


def specification(name: str, topic: str) -> str:
    return SPECIFICATION.replace("NAME", name).replace("TOPIC", topic)


@pytest.fixture(scope="module")
def common_appliance() -> Iterator[Appliance]:
    need_ros()
    monitors = {one: specification(one, one) for one in ("left", "right")}
    with Appliance(monitors=monitors, options=("--api", "off"), relays=2) as appliance:
        yield appliance


@pytest.fixture
def appliance(common_appliance: Appliance) -> Iterator[Appliance]:
    common_appliance.ignore_earlier_records()
    yield common_appliance
    for name in rows(common_appliance):
        common_appliance.rosrv("monitor", "remove", name)
    common_appliance.rosrv("monitor", "reload")


def rows(appliance: Appliance) -> dict[str, dict[str, object]]:
    lines = appliance.rosrv("monitor", "list", "--json").stdout.splitlines()
    return {row["name"]: row for row in map(json.loads, lines)}


def is_connected(listener: Process) -> bool:
    with ServerProxy(str(listener.wait_for(event="ready")["uri"])) as node:
        answer: Any = node.getBusInfo("/tests")
    return any(topic != "/rosout" and connected for _, _, _, _, topic, connected, *_ in answer[2])


def relay_of(appliance: Appliance, number: int) -> int:
    name = "rosrv: relay" if number == 1 else f"rosrv: relay-{number}"
    for pid in appliance.pids("relay"):
        if Path(f"/proc/{pid}/cmdline").read_bytes().rstrip(b"\0 ").decode() == name:
            return pid
    raise AssertionError(f"no process is called {name}")


def test_the_death_of_a_relay_does_not_affect_the_other(appliance: Appliance, ros: RosSession) -> None:
    left, right = ros.listener("rospy", "/left"), ros.listener("roscpp", "/right")
    alarms = [ros.listener("rospy", f"/{one}/alarm") for one in ("left", "right")]
    for alarm in alarms:
        eventually(partial(is_connected, alarm), alarm.story)  # the alarm is sent once
    ros.talker("roscpp", "/left", name="one")
    ros.talker("rospy", "/right", name="other")
    for alarm, word in zip(alarms, ("left", "right"), strict=True):
        told = alarm.wait_for(event="received")
        assert (told["data"], told["publisher"]) == (f"three on {word}", "/rosrv")
    for listener in (left, right):
        listener.wait_for_count(5, event="received")
    assert len(appliance.pids("relay")) == 2
    killed = relay_of(appliance, 1)
    os.kill(killed, signal.SIGKILL)
    before = len(left.seen(event="received"))
    left.wait_for_count(before + 5, event="received")
    right.wait_for_count(len(right.seen(event="received")) + 5, event="received")
    heard = [event["data"].split() for event in right.seen(event="received")]
    assert without_gap(numbers(right.seen(event="received")))
    assert without_gap([int(words[1]) for words in heard])
    assert len(alarms[0].seen(event="received")) == 1  # the third message has come, and never comes again
    assert not appliance.audit(event="monitors restarted")
    eventually(lambda: int(str(rows(appliance)["right"]["events"])) > 5, "the counters of the second relay")
    assert set(rows(appliance)) == {"left", "right"}


def test_loading_a_specification_across_relays_moves_only_one_monitor(
    appliance: Appliance, ros: RosSession, tmp_path: Path
) -> None:
    listeners = {
        (one, client): ros.listener(client, f"/{one}")
        for one in ("left", "right")
        for client in ("rospy", "roscpp")
    }
    for one in ("left", "right"):
        ros.talker("roscpp", f"/{one}", name=f"talks_{one}")
    for listener in listeners.values():
        listener.wait_for_count(5, event="received")
    path = tmp_path / "both.rv"
    path.write_text(
        "both() { int n = 0;"
        " event a() /left std_msgs/String '{}' { n++; }"
        " event b(std::string text) /right std_msgs/String '{data:text}' { text = \"both \" + text; } }"
    )
    done = appliance.rosrv("monitor", "load", str(path))
    for listener in listeners.values():
        listener.wait_for_count(len(listener.seen(event="received")) + 5, event="received")
    for client in ("rospy", "roscpp"):
        said = listeners["right", client].wait_for(lambda event: "both" in event.get("data", ""))
        assert " right " in f" {said['data']}"
    moved = appliance.recorded(event="topics moved")[0]
    assert moved["detail"]["monitors"] == ["right"]
    assert moved["severity"] == "alarm"
    assert "right started in the initial state" in done.stdout
    stayed = [event["data"].split() for event in listeners["left", "roscpp"].seen(event="received")]
    assert without_gap([int(words[1]) for words in stayed])
    appliance.rosrv("monitor", "remove", "both")
    for listener in listeners.values():
        before = len(listener.seen(event="received"))
        listener.wait_for_count(before + 5, event="received")
    assert set(rows(appliance)) == {"left", "right"}


def test_services_use_the_relay_of_their_monitor(
    appliance: Appliance, ros: RosSession, tmp_path: Path
) -> None:
    ros.service_server("rospy", "/mode")
    ros.service_server("roscpp", "/other_mode")
    clients = [ros.service_client("roscpp", "/mode"), ros.service_client("rospy", "/other_mode")]
    path = tmp_path / "gate.rv"
    path.write_text(
        "gate() { event wish(bool data) service /mode std_srvs/SetBool request '{data:data}'"
        ' { ROS_WARN("seen"); }'
        " event other(bool data) service /other_mode std_srvs/SetBool request '{data:data}' { } }"
    )
    for client in clients:
        client.send("true")
        client.wait_for(event="answered")
    appliance.rosrv("monitor", "load", str(path))
    appliance.kill("control")
    eventually(lambda: len(rows(appliance)) == 3, "control is back")
    for client in clients:
        client.send("true")
        client.wait_for_count(2, event="answered")
    eventually(lambda: int(str(rows(appliance)["gate"]["events"])) == 2, "the monitor has seen both requests")


@pytest.mark.parametrize("client", CLIENTS)
def test_one_message_after_waiting_for_a_subscriber_is_not_lost_to_the_monitor(
    common_appliance: Appliance, tmp_path: Path, client: Client
) -> None:
    """The monitor is the subscriber that the node waits for, and the relay repeats its first second to listeners.

    On an overloaded machine a listener may need longer, so each must get three of twelve messages. Without the
    repetition, a roscpp listener gets none.
    """
    with RosSession(common_appliance.master_uri, tmp_path) as ros:
        listeners = [ros.listener(client, "/left", name=f"ear{number}") for number in range(2)]
        for number in range(12):
            talker = ros.node("rospy", "patient_talker", "/left", name=f"voice{number}")
            talker.wait_for(event="sent")
            for listener in listeners:
                with suppress(AssertionError):
                    listener.wait_for(event="received", publisher=f"/voice{number}", timeout=5)
            talker.stop()
            heard = [[event["publisher"] for event in one.seen(event="received")] for one in listeners]
            if all(len(each) >= 3 for each in heard):
                break
        for each in heard:
            assert len(each) == len(set(each)) >= 3, ros.story()


@pytest.mark.parametrize("master", ["plain", "appliance"])
@pytest.mark.parametrize("client", CLIENTS)
def test_a_new_subscriber_gets_no_old_messages(
    request: pytest.FixtureRequest, masters: Masters, tmp_path: Path, client: Client, master: str
) -> None:
    with ExitStack() as stack:
        if master == "plain":
            uri = stack.enter_context(masters.lend("plain", "loopback")).master_uri
        else:
            uri = request.getfixturevalue("common_appliance").master_uri
        ros = stack.enter_context(RosSession(uri, tmp_path))
        talker = ros.talker(client, "/left", "--rate", "20")
        talker.wait_for_count(30, event="sent")
        for name in ("first", "second"):
            said = talker.seen(event="sent")[-1]["number"]
            listener = ros.listener(client, "/left", name=name)
            heard = listener.wait_for(event="received")["data"]
            assert int(heard.split()[-1]) > said
            listener.stop()
            talker.wait_for_count(said + 60, event="sent")
