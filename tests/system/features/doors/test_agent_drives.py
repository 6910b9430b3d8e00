"""An agent with roslibpy: it asks, drives for the time of its approval while it holds the group, and loses both."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.support.processes import Process
from tests.support.waiting import eventually
from tests.system.features.doors.test_roslib import IN_PYTHON, python

__all__ = ["python"]
POLICY = """
[Groups]
site = 10.77.0.0/24
agent = door:agent-1
[Nodes]
default = site agent
[Publishers]
default = site
/cmd_vel = site, ask agent
[Subscribers]
default = site agent
[Commands]
default = site agent
[Authority]
base = /cmd_vel
override base = site
ask base = agent
lease base = 60s
"""
SILENCE = 1.0
"""Seconds, in which ten commands of the agent would be heard."""


@pytest.fixture
def appliance(common_lab: Lab) -> Iterator[Appliance]:
    with Appliance(common_lab.host("appliance", "10.77.0.2/24"), policy=POLICY) as running:
        running.rosrv("door", "add", "agent-1", "--port", "9091", "--from", "10.77.0.10")
        eventually(lambda: not running.row("door", "list")["trouble"], "the door serves")
        yield running


def drives(base: Process) -> bool:
    """Whether the base hears the agent from now on, within a second."""
    first, tick = len(base.events), base.mark()
    try:
        base.wait_for(lambda event: ",0.3," in str(event.get("text")), timeout=SILENCE, since=tick)
    except AssertionError:
        return False
    return len(base.events) > first


def test_an_agent_drives_while_it_is_approved_and_holds_the_group(
    appliance: Appliance, common_robot: Host, python: Path, tmp_path: Path
) -> None:
    with RosSession(appliance.master_uri, tmp_path, common_robot) as ros:
        base = ros.start(["rostopic", "echo", "-p", "/cmd_vel"])
        ros.start([str(python), str(IN_PYTHON / "drive.py"), "10.77.0.2", "9091"], label="agent")
        rows = eventually(
            lambda: [
                row for row in appliance.rows("approve")[0]["approvals"] if row["resource"] == "/cmd_vel"
            ],
            "the agent's call waits",
        )
        assert not drives(base), "nobody has approved it"
        appliance.rosrv("approve", str(rows[0]["number"]), "--for", "300s")
        assert not drives(base), "it does not hold the group"
        appliance.rosrv("drive", "free", "base", "--to", "door:agent-1")
        eventually(lambda: drives(base), "the agent drives")
        appliance.rosrv("drive", "assign", "base", "--host", "10.77.0.10")
        eventually(lambda: not drives(base), "another host drives")
        appliance.rosrv("drive", "free", "base", "--to", "door:agent-1")
        eventually(lambda: drives(base), "the agent drives again, without a new connection")
        appliance.rosrv("approval", "refuse", str(rows[0]["number"]))
        eventually(lambda: not drives(base), "its approval has ended")
