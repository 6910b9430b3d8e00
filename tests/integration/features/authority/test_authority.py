from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from appliance.features.authority.requests import DriveStatus, GroupState
from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.support.processes import Process
from tests.support.waiting import eventually

PILOT, BOSS = "10.77.0.66", "10.77.0.67"
SOME = 15
SETTINGS = "authority: {nodes_may_call: true}\n"
POLICY = f"""
[Nodes]
default = *
[Publishers]
default = *
[Subscribers]
default = *
[Commands]
default = *
[Authority]
base = /chatter
take base = {PILOT}
override base = {BOSS}
lease base = 3s
"""


class Site(NamedTuple):
    appliance: Appliance
    listener: Process
    pilot_node: Process
    boss: Process
    tablet: RosSession

    def heard(self, name: str) -> set[str]:
        self.listener.wait_for(event="received", publisher=name, since=self.listener.mark())
        first = self.listener.mark()
        self.listener.wait_for_count(SOME, event="received", publisher=name, since=first)
        return {event["publisher"] for event in self.listener.events[first:] if "publisher" in event}

    def state(self) -> GroupState:
        return self.appliance.ask(DriveStatus()).groups[0]

    def explained(self) -> str:
        words = ("--host", PILOT, "--node", "/pilot", "--publish", "/chatter")
        return self.appliance.rosrv("policy", "explain", *words).stdout

    def drive(self, *words: str, check: bool = True) -> str:
        done = self.appliance.rosrv("drive", *words, check=check)
        return done.stdout + done.stderr


@pytest.fixture
def site(lab: Lab, robot: Host, tmp_path: Path) -> Iterator[Site]:
    with (
        Appliance(lab.host("appliance", "10.77.0.2/24"), policy=POLICY, settings=SETTINGS) as appliance,
        RosSession(appliance.master_uri, tmp_path, robot) as ros,
    ):
        pilot, boss = ros.on(lab.host("pilot", f"{PILOT}/24")), ros.on(lab.host("boss", f"{BOSS}/24"))
        yield Site(
            appliance,
            ros.listener("rospy", "/chatter"),
            pilot.talker("rospy", "/chatter", name="pilot"),
            boss.talker("rospy", "/chatter", name="boss"),
            pilot,
        )


def test_one_host_at_a_time_is_heard(site: Site) -> None:
    eventually(
        lambda: {PILOT, BOSS} == {one.host for one in site.state().not_carried}, "both publish in vain"
    )
    [notice] = [line for line in site.appliance.status()["attention"] if "not carried" in line]
    assert (
        f"{PILOT} (/pilot) to /chatter" in notice and "no host holds base: rosrv drive assign base" in notice
    )
    assert f"not carried: messages of {PILOT} (/pilot) to /chatter" in site.drive("status")
    assert f"because no host holds base: rosrv drive assign base --host {PILOT}\n" in site.explained()
    assert site.drive("assign", "base", "--host", PILOT).startswith(f"base: held by {PILOT}")
    assert site.heard("/pilot") == {"/pilot"}
    site.pilot_node.kill()
    site.tablet.talker("rospy", "/chatter", name="pilot")
    assert site.heard("/pilot") == {"/pilot"}, "a node that restarts within the lease has its group"
    site.appliance.kill("relay")
    assert site.heard("/pilot") == {"/pilot"}, "and so has one whose relay restarts"
    site.drive("assign", "base", "--host", BOSS)
    assert site.heard("/boss") == {"/boss"}
    assert f"{BOSS} holds base" in site.drive("assign", "base", "--host", PILOT, check=False)
    answer = site.tablet.run("rosservice", "call", "/rosrv/drive/take").stdout
    assert "success: False" in answer
    site.drive("ask", "base", "--host", PILOT)
    site.boss.kill()
    eventually(lambda: site.state().holder == PILOT, "the pilot holds the group")
    assert site.heard("/pilot") == {"/pilot"}
    answer = site.tablet.run("rosservice", "call", "/rosrv/drive/give").stdout
    assert "success: True" in answer
    site.appliance.kill("control")
    eventually(lambda: site.state().holder == "", "nobody holds the group")
    assert "no host holds it" in site.explained()
    assert "success: True" in site.tablet.run("rosservice", "call", "/rosrv/drive/take").stdout
    assert site.heard("/pilot") == {"/pilot"}
    assert len(site.appliance.recorded("--event", "authority handed over", count=5)) >= 5
