"""A gamepad and a planner on one computer, and a base: who moves drives."""

import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from appliance.features.authority.requests import DriveStatus, GroupState
from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.support.processes import Process
from tests.support.waiting import eventually

OCU = "10.77.0.66"
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
base = /cmd_vel
rank base = {OCU}/gamepad > {OCU}/planner
free base = 300ms
"""
FREE = 0.3
"""Seconds after a zero in which no lower rank is heard: `free base`."""
QUICK = 0.1
"""The longest hand-over in seconds."""
IN_FLIGHT = 0.02
"""Seconds in which a command that the relay passed before a hand-over may reach the base, by another connection."""
MAX = 1.0
"""The delay in seconds that a busy machine may add."""


class Site(NamedTuple):
    appliance: Appliance
    base: Process
    driver: Process
    clock: Process
    gamepad: Process
    planner: Process

    def state(self) -> GroupState:
        return self.appliance.ask(DriveStatus()).groups[0]

    def heard(self, name: str) -> set[str]:
        """Wait until the base hears a node, and return the nodes that it hears from then on."""
        self.base.wait_for(event="received", publisher=name, since=self.base.mark())
        first = self.base.mark()
        self.base.wait_for_count(10, event="received", publisher=name, since=first)
        return {event["publisher"] for event in self.base.events[first:] if "publisher" in event}

    def hears_nobody(self, tenths: int) -> bool:
        """Whether the base hears nothing during this number of messages of a talker, ten of which come in a second."""
        first = self.base.mark()
        self.clock.wait_for_count(tenths, event="received", since=self.clock.mark())
        return not any("publisher" in event for event in self.base.events[first:])


@pytest.fixture
def site(lab: Lab, robot: Host, tmp_path: Path) -> Iterator[Site]:
    with (
        Appliance(lab.host("appliance", "10.77.0.2/24"), policy=POLICY) as appliance,
        RosSession(appliance.master_uri, tmp_path, robot) as ros,
    ):
        ros.talker("rospy", "/tick")
        ocu = ros.on(lab.host("ocu", f"{OCU}/24"))
        yield Site(
            appliance,
            ros.node("rospy", "commanded_base"),
            ros.listener("rospy", "/rosrv/driver/base"),
            ros.listener("rospy", "/tick"),
            ocu.node("rospy", "stick", name="gamepad"),
            ocu.node("rospy", "stick", name="planner"),
        )


def test_a_gamepad_drives_while_it_moves(site: Site) -> None:
    """And silence after a motion waits for a person, over restarts of the relays and of RVMaster."""
    site.planner.send("0.3")
    site.driver.wait_for(event="received", publisher="/rosrv")
    assert site.hears_nobody(20), "after a start, nobody knows who moves"
    site.appliance.rosrv("drive", "free", "base")
    assert site.heard("/planner") == {"/planner"}
    assert (site.state().driver, site.state().standing) == ("/planner", "moving")

    mark, moved = site.base.mark(), time.monotonic()
    site.gamepad.send("0.5")
    site.base.wait_for(event="received", publisher="/gamepad", since=mark)
    assert time.monotonic() - moved < QUICK + MAX
    assert site.heard("/gamepad") == {"/gamepad"}
    assert site.state().holder == OCU
    site.gamepad.send("0")
    assert site.heard("/planner") == {"/planner"}

    site.gamepad.send("0.5")
    assert site.heard("/gamepad") == {"/gamepad"}
    site.gamepad.send("silent")
    eventually(lambda: site.state().standing == "lost", "the gamepad is lost")
    for role in ("relay", "control"):
        site.appliance.kill(role)
        eventually(lambda: site.state().standing == "lost", "the gamepad is still lost")
        assert site.hears_nobody(30)
    site.gamepad.send("0")
    assert site.heard("/planner") == {"/planner"}
    site.appliance.kill("relay")
    assert site.heard("/planner") == {"/planner"}
    assert any("/planner" in event.get("data", "") for event in site.driver.events)
    reasons = [row["reason"] for row in site.appliance.recorded("--event", "authority handed over", count=4)]
    assert any("moved (/gamepad)" in reason for reason in reasons), reasons
    explained = ("policy", "explain", "--host", OCU, "--node", "/planner", "--publish", "/cmd_vel")
    assert "no higher rank of base does" in site.appliance.rosrv(*explained).stdout


def test_a_hundred_hand_overs_are_quick_and_never_mixed(
    site: Site, record_property: Callable[[str, object], None]
) -> None:
    """A gamepad takes over from a planner that moves all the time, and lets go. Both are nodes of rospy."""
    site.planner.send("0.3")
    site.driver.wait_for(event="received", publisher="/rosrv")
    site.appliance.rosrv("drive", "free", "base")
    assert site.heard("/planner") == {"/planner"}
    taken: list[float] = []
    given: list[float] = []
    for _ in range(100):
        mark, told = site.base.mark(), site.gamepad.mark()
        site.gamepad.send("0.5")
        heard = site.base.wait_for(event="received", publisher="/gamepad", since=mark)
        first = len(site.base.events)
        taken.append(heard["at"] - site.gamepad.wait_for(event="commanded", since=told)["at"])
        site.base.wait_for_count(4, event="received", publisher="/gamepad", since=mark)
        told = site.gamepad.mark()
        site.gamepad.send("0")
        let_go = site.gamepad.wait_for(event="commanded", speed=0.0, since=told)["at"]
        heard = site.base.wait_for(event="received", publisher="/planner", since=first)
        given.append(heard["at"] - let_go - FREE)
        order = [event for event in site.base.events[mark:] if "publisher" in event]
        drives = [event["at"] for event in order if event["publisher"] == "/gamepad" and event["speed"]]
        mixed = [
            one
            for one in order
            if one["publisher"] == "/planner" and drives[0] + IN_FLIGHT < one["at"] < drives[-1]
        ]
        assert not mixed, order
    record_property("ms", {name: _figures(seconds) for name, seconds in (("taken", taken), ("given", given))})
    assert min(given) > 0, "the planner was heard before the time of `free` was over"
    assert max(statistics.median(taken), statistics.median(given)) < QUICK
    assert max(taken + given) < QUICK + MAX


def _figures(seconds: list[float]) -> str:
    return f"p50 {statistics.median(seconds) * 1e3:.1f}, max {max(seconds) * 1e3:.1f}"
