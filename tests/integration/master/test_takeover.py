"""When a node's machine is gone, a node on another host immediately takes over its name.

`tests/unit/master/conversations/attacks.txt` has the answers while the node runs or hangs.
"""

import itertools
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.support.processes import Process
from tests.support.site import Masters

DROPPING = "add table inet gone; add chain inet gone in { type filter hook input priority 0; policy drop; }"
_NUMBERS = itertools.count(40, 3)  # for the machines of a test


@dataclass
class Pair:
    lab: Lab
    appliance: Appliance
    first: Host
    second: Host
    ros: RosSession
    ear: Process
    voice: str
    topic: str

    def talker(self, host: Host) -> Process:
        return self.ros.on(host).talker("rospy", self.topic, "--text", host.name, name=self.voice[1:])


@pytest.fixture
def pair(masters: Masters, tmp_path: Path) -> Iterator[Pair]:
    number = next(_NUMBERS)
    voice, topic = f"/voice{number}", f"/chatter{number}"
    with masters.lend("appliance", "lab") as site:
        first, second, third = (
            site.lab.host(f"{name}{number}", f"10.77.0.{number + place}/24")
            for place, name in enumerate(("first", "second", "third"))
        )
        with RosSession(site.master_uri, tmp_path, third) as ros:
            ear = ros.listener("roscpp", topic, name=f"ear{number}")
            yield Pair(site.lab, site.appliance, first, second, ros, ear, voice, topic)


def unplugged(pair: Pair, _voice: Process) -> None:
    pair.lab.unplug(pair.first)


def dropped(pair: Pair, _voice: Process) -> None:
    nft = pair.first.popen(["nft", DROPPING])
    assert nft.wait() == 0


def deleted(pair: Pair, voice: Process) -> None:
    pair.lab.unplug(pair.first)
    voice.popen.send_signal(signal.SIGKILL)
    voice.wait()
    pair.first.namespace.delete()


@pytest.mark.parametrize("away", [unplugged, dropped, deleted])
def test_a_vanished_machine_releases_its_names(pair: Pair, away: Callable[[Pair, Process], None]) -> None:
    """The node on the other machine succeeds at its first attempt, even before the silent node counts as lost."""
    voice = pair.talker(pair.first)
    pair.ear.wait_for(event="received")
    away(pair, voice)
    pair.talker(pair.second)
    pair.ear.wait_for(lambda event: str(event.get("data", "")).startswith("second"))
    voice.kill()  # when interrupted, the node would wait for its master
    [taken] = pair.appliance.recorded("--event", "takeover", caller_id=pair.voice)
    lost = pair.appliance.audit("--event", "node lost", caller_id=pair.voice)
    assert [record for record in lost if record["sequence"] < taken["sequence"]] == []
