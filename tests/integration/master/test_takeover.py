"""A node's machine is away: the node of its name on another host that the policy grants has the name at once.

A ROS 1 node registers once: what is refused is refused until somebody starts the node again.
"""

import itertools
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import Client, RosSession, has_ros
from tests.support.processes import Process
from tests.support.requirements import needs
from tests.support.rosmaster import call_on
from tests.support.waiting import eventually

CLIENTS: list[Client] = ["rospy", "roscpp"]
DROPPING = "add table inet gone; add chain inet gone in { type filter hook input priority 0; policy drop; }"
_NUMBERS = itertools.count(40, 3)  # of the machines of a test


@dataclass
class Pair:
    """Two machines whose nodes may both be /voice, and a third that listens."""

    lab: Lab
    appliance: Appliance
    first: Host
    second: Host
    ros: RosSession
    ear: Process
    voice: str
    topic: str

    def talker(self, client: Client, host: Host) -> Process:
        """The voice on a host; `ready` when its constructor is done, whatever the master said."""
        return self.ros.on(host).talker(client, self.topic, "--text", host.name, name=self.voice[1:])

    def registered(self) -> Any:
        """What the voice of the second machine is told when it registers."""
        register = ("registerPublisher", self.voice, self.topic, "std_msgs/String")
        return call_on(self.second, self.appliance.master_uri, *register, f"http://{self.second.address}:9/")


@pytest.fixture
def pair(common_lab: Lab, appliance: Appliance, tmp_path: Path) -> Iterator[Pair]:
    """An appliance with the default times and a listener; machines, voice and topic are of this test alone."""
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
    number = next(_NUMBERS)
    hosts = [
        common_lab.host(f"{name}{number}", f"10.77.0.{number + place}/24")
        for place, name in enumerate(("first", "second", "third"))
    ]
    voice, topic = f"/voice{number}", f"/chatter{number}"
    with RosSession(appliance.master_uri, tmp_path, hosts[2]) as ros:
        ear = ros.listener("roscpp", topic, name=f"ear{number}")
        yield Pair(common_lab, appliance, hosts[0], hosts[1], ros, ear, voice, topic)


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
    [taken] = pair.appliance.recorded("--event", "takeover", caller_id=pair.voice)
    lost = pair.appliance.audit("--event", "node lost", caller_id=pair.voice)
    assert [record for record in lost if record["sequence"] < taken["sequence"]] == []


def test_a_node_that_hangs_holds_its_name_until_it_is_lost(pair: Pair) -> None:
    """It takes connections and answers nothing: the refusal says so and when to come again, and then it is granted."""
    voice = pair.talker("rospy", pair.first)
    pair.ear.wait_for(event="received")
    voice.popen.send_signal(signal.SIGSTOP)
    try:
        code, why, _ = pair.registered()
        assert code == 0
        assert "takes connections and does not answer" in why
        seconds = int(why.partition("unregistered in ")[2].partition(" s")[0])
        assert 0 < seconds <= 25
        eventually(lambda: pair.registered()[0] == 1, why)
    finally:
        voice.kill()  # it would go on to publish without its name


def test_a_node_that_runs_holds_its_name(pair: Pair) -> None:
    """It answers: the other is refused at once, and goes on talking to nobody."""
    pair.talker("rospy", pair.first)
    pair.ear.wait_for(event="received")
    code, why, _ = pair.registered()
    assert code == 0
    assert "is held by a running node" in why
