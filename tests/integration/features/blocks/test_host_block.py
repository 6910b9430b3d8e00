from collections.abc import Iterator
from typing import NamedTuple

import pytest

from appliance.features.blocks.requests import HostBlocks, HostUnblock
from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import Client, RosSession
from tests.support.processes import Process

TABLET = "10.77.0.66"
SOME = 15


@pytest.fixture(scope="module")
def appliance(own_appliance: Appliance) -> Appliance:
    return own_appliance


@pytest.fixture(scope="module")
def tablet(common_lab: Lab) -> Host:
    return common_lab.host("tablet", f"{TABLET}/24")


class Robot(NamedTuple):
    listener: Process
    tablet: RosSession

    def hears(self, name: str) -> None:
        self.listener.wait_for(event="received", publisher=name, since=self.listener.mark())

    def heard(self) -> set[str]:
        for _ in range(SOME):
            self.hears("/friend")  # messages that were already sent have arrived
        first = self.listener.mark()
        self.listener.wait_for_count(SOME, event="received", publisher="/friend", since=first)
        return {event["publisher"] for event in self.listener.events[first:] if "publisher" in event}


@pytest.fixture
def robot(appliance: Appliance, ros: RosSession, tablet: Host) -> Iterator[Robot]:
    appliance.ignore_earlier_records()
    client: Client = "rospy"
    listener = ros.listener(client, "/chatter")
    ros.talker("roscpp", "/chatter", name="friend")
    ros.on(tablet).talker(client, "/chatter", name="stranger")
    found = Robot(listener, ros.on(tablet))
    found.hears("/friend")
    found.hears("/stranger")
    yield found
    for row in appliance.ask(HostBlocks()).blocks:
        appliance.ask(HostUnblock(row.address))


@pytest.mark.real
def test_a_blocked_host_is_silent_until_it_is_unblocked(appliance: Appliance, robot: Robot) -> None:
    said = appliance.rosrv("host", "block", TABLET, "--for", "1h", "--note", "tablet lost").stdout
    assert said.startswith(f"{TABLET} is blocked until ")
    assert "it lost 2 publications, 2 services, " in said  # /chatter and /rosout, and rospy's loggers
    assert robot.heard() == {"/friend"}

    assert robot.tablet.run("rostopic", "list", check=False).returncode != 0
    [denied, *_] = appliance.recorded("--deny", "--event", "decision", host=TABLET)
    assert denied["reason"].startswith(f"{TABLET} is blocked by operator until ")
    assert denied["reason"].endswith(f": tablet lost; lift it with `rosrv host unblock {TABLET}`")
    assert f"{TABLET} is blocked by operator" in appliance.rosrv("audit", "why", denied["id"]).stdout
    explained = appliance.rosrv(
        "policy", "explain", "--host", TABLET, "--node", "/stranger", "--publish", "/chatter", check=False
    )
    assert explained.returncode == 1
    assert f"denied: {TABLET} is blocked by operator until " in explained.stdout
    assert f"answer to the host: {TABLET} is blocked by an operator\n" in explained.stdout
    assert any("1 host is blocked, the block ends at" in line for line in appliance.status()["attention"])

    assert "4 registrations returned" in appliance.rosrv("host", "unblock", TABLET).stdout
    robot.hears("/stranger")
    assert "/chatter" in robot.tablet.run("rostopic", "list").stdout
