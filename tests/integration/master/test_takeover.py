"""When a node's machine is gone, a node on another host can take over its name at once if the policy allows.

A ROS 1 node registers only once, so it must be restarted after a denial.
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
from tests.support.field import Impostor, answering
from tests.support.nodes import Client, RosSession
from tests.support.processes import Process
from tests.support.rosmaster import call_on
from tests.support.site import Masters
from tests.support.waiting import eventually

CLIENTS: list[Client] = ["rospy", "roscpp"]
DROPPING = "add table inet gone; add chain inet gone in { type filter hook input priority 0; policy drop; }"
_NUMBERS = itertools.count(40, 3)  # for the machines of a test


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
    api: str
    """The URI of the voice on the second machine, which answers."""

    def talker(self, client: Client, host: Host) -> Process:
        """Start the voice on a host; `ready` is set when its constructor returns, whatever the master answered."""
        return self.ros.on(host).talker(client, self.topic, "--text", host.name, name=self.voice[1:])

    def registered(self) -> Any:
        """Return the answer to the registration of the voice on the second machine."""
        register = ("registerPublisher", self.voice, self.topic, "std_msgs/String")
        return call_on(self.second, self.appliance.master_uri, *register, self.api)


@pytest.fixture
def pair(masters: Masters, tmp_path: Path) -> Iterator[Pair]:
    """Provide an appliance with default times and a listener; machines, voice and topic belong to this test alone."""
    number = next(_NUMBERS)
    voice, topic = f"/voice{number}", f"/chatter{number}"
    with masters.lend("appliance", "lab") as site:
        first, second, third = (
            site.lab.host(f"{name}{number}", f"10.77.0.{number + place}/24")
            for place, name in enumerate(("first", "second", "third"))
        )
        with (
            RosSession(site.master_uri, tmp_path, third) as ros,
            Impostor(second, answering([1, "", 4711])) as node,
        ):
            ear = ros.listener("roscpp", topic, name=f"ear{number}")
            yield Pair(site.lab, site.appliance, first, second, ros, ear, voice, topic, node.uri)


def unplugged(pair: Pair, _voice: Process) -> None:
    """Unplug the cable."""
    pair.lab.unplug(pair.first)


def dropped(pair: Pair, _voice: Process) -> None:
    """Drop packets silently, as behind a router."""
    nft = pair.first.popen(["nft", DROPPING])
    assert nft.wait() == 0


def deleted(pair: Pair, voice: Process) -> None:
    """Delete the machine and its network without notice."""
    pair.lab.unplug(pair.first)
    voice.popen.send_signal(signal.SIGKILL)
    voice.wait()
    pair.first.namespace.delete()


@pytest.mark.parametrize("client", CLIENTS)
@pytest.mark.parametrize("away", [unplugged, dropped, deleted])
def test_a_vanished_machine_releases_its_names(
    pair: Pair, away: Callable[[Pair, Process], None], client: Client
) -> None:
    """After a loss of cable, power or container, the node on the other machine is heard at its first attempt.

    This holds even before the silent node counts as lost.
    """
    voice = pair.talker("rospy", pair.first)
    pair.ear.wait_for(event="received")
    away(pair, voice)
    pair.talker(client, pair.second)
    pair.ear.wait_for(lambda event: str(event.get("data", "")).startswith("second"))
    voice.kill()  # when interrupted, the node would wait for its master
    [taken] = pair.appliance.recorded("--event", "takeover", caller_id=pair.voice)
    lost = pair.appliance.audit("--event", "node lost", caller_id=pair.voice)
    assert [record for record in lost if record["sequence"] < taken["sequence"]] == []


def test_a_hanging_node_keeps_its_name_until_it_is_lost(pair: Pair) -> None:
    """A node that accepts connections but does not answer keeps its name until it is lost.

    The refusal says when to retry.
    """
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
        withdraw = ("unregisterPublisher", pair.voice, pair.topic, pair.api)
        assert call_on(pair.second, pair.appliance.master_uri, *withdraw)[2] == 1
    finally:
        voice.kill()  # without this, the node would publish without its name


def test_a_running_node_keeps_its_name(pair: Pair) -> None:
    """A node that answers keeps its name: the other node is refused at once, and publishes to no subscriber."""
    pair.talker("rospy", pair.first)
    pair.ear.wait_for(event="received")
    code, why, _ = pair.registered()
    assert code == 0
    assert "is held by a running node" in why
