"""A node's machine is away: the node of its name on another host that the policy grants has the name at once.

A ROS 1 node registers once: what is refused is refused until somebody starts the node again.
"""

import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import Client, RosSession, has_ros
from tests.support.processes import Process
from tests.support.requirements import need_root, needs
from tests.support.rosmaster import call_on
from tests.support.waiting import eventually

CLIENTS: list[Client] = ["rospy", "roscpp"]
DROPPING = "add table inet gone; add chain inet gone in { type filter hook input priority 0; policy drop; }"
API = "http://10.77.0.20:9/"


@dataclass
class Pair:
    """Two machines whose nodes may both be /voice, and a third that listens."""

    lab: Lab
    appliance: Appliance
    first: Host
    second: Host
    ros: RosSession
    ear: Process

    def talker(self, client: Client, host: Host) -> Process:
        """/voice on a host; `ready` when its constructor is done, whatever the master said."""
        return self.ros.on(host).talker(client, "/chatter", "--text", host.name, name="voice")


@pytest.fixture
def pair(lab: Lab, tmp_path: Path) -> Iterator[Pair]:
    """An appliance with the default times, and a listener."""
    need_root()
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
    first, second = lab.host("first", "10.77.0.10/24"), lab.host("second", "10.77.0.20/24")
    third = lab.host("third", "10.77.0.30/24")
    with (
        Appliance(lab.host("appliance", "10.77.0.2/24"), options=("--api", "off")) as appliance,
        RosSession(appliance.master_uri, tmp_path, third) as ros,
    ):
        yield Pair(lab, appliance, first, second, ros, ros.listener("roscpp", "/chatter", name="ear"))


def unplugged(pair: Pair, _voice: Process) -> None:
    """The cable is out."""
    pair.lab.unplug(pair.first)


def dropped(pair: Pair, _voice: Process) -> None:
    """Packets get lost on the way, without a word: as behind a router."""
    nft = pair.first.popen(["nft", DROPPING])
    assert nft.wait() == 0


def deleted(pair: Pair, voice: Process) -> None:
    """The machine and its network are no more, and said nothing when they went."""
    pair.lab.unplug(pair.first)
    voice.popen.send_signal(signal.SIGKILL)
    voice.wait()
    pair.first.namespace.delete()


@pytest.mark.parametrize("client", CLIENTS)
@pytest.mark.parametrize("away", [unplugged, dropped, deleted])
def test_a_machine_that_vanished_holds_no_name(
    pair: Pair, away: Callable[[Pair, Process], None], client: Client
) -> None:
    """Cable, power, a deleted container: the node on the other machine is heard at its first try, before the silence of
    the other has lasted so long that it is lost.
    """
    voice = pair.talker("rospy", pair.first)
    pair.ear.wait_for(event="received")
    away(pair, voice)
    pair.talker(client, pair.second)
    pair.ear.wait_for(lambda event: str(event.get("data", "")).startswith("second"))
    voice.kill()  # it would wait for its master when it is interrupted
    [taken] = pair.appliance.recorded("--event", "takeover")
    lost = pair.appliance.audit("--event", "node lost", caller_id="/voice")
    assert [record for record in lost if record["sequence"] < taken["sequence"]] == []


def test_a_node_that_hangs_holds_its_name_until_it_is_lost(pair: Pair) -> None:
    """It takes connections and answers nothing: the refusal says so and when to come again, and then it is granted."""
    voice = pair.talker("rospy", pair.first)
    pair.ear.wait_for(event="received")
    voice.popen.send_signal(signal.SIGSTOP)
    try:
        register = ("registerPublisher", "/voice", "/chatter", "std_msgs/String", API)
        code, why, _ = call_on(pair.second, pair.appliance.master_uri, *register)
        assert code == 0
        assert "takes connections and does not answer" in why
        seconds = int(why.partition("unregistered in ")[2].partition(" s")[0])
        assert 0 < seconds <= 25
        eventually(lambda: call_on(pair.second, pair.appliance.master_uri, *register)[0] == 1, why)
    finally:
        voice.popen.send_signal(signal.SIGCONT)


def test_a_node_that_runs_holds_its_name(pair: Pair) -> None:
    """It answers: the other is refused at once, and goes on talking to nobody."""
    pair.talker("rospy", pair.first)
    pair.ear.wait_for(event="received")
    register = ("registerPublisher", "/voice", "/chatter", "std_msgs/String", API)
    code, why, _ = call_on(pair.second, pair.appliance.master_uri, *register)
    assert code == 0
    assert "is held by a running node" in why
