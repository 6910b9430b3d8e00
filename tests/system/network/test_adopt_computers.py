"""A robot of two computers is adopted: one of them boots later, reboots alone, or loses its power in the middle."""

import json
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.adopted_robot import Robot, crash, rosrv, until_taken
from tests.support.appliance import Appliance
from tests.support.command import ROSRV
from tests.support.nodes import Client, RosSession
from tests.support.processes import LIMIT
from tests.support.rosmaster import PlainMaster

CLIENTS: tuple[Client, Client] = ("rospy", "roscpp")
OTHER = {"robot": "nuc", "nuc": "robot"}

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(3600)]


@pytest.fixture
def computers(lab: Lab, host: Host, tmp_path: Path) -> Iterator[dict[str, Robot]]:
    nuc = lab.host("nuc", "10.77.0.11/24")
    with (
        RosSession("http://localhost:11311", tmp_path, host) as here,
        RosSession(f"http://{host.address}:11311", tmp_path, nuc) as there,
    ):
        yield {"robot": Robot(host, here, {}, {}), "nuc": Robot(nuc, there, {}, {})}


def boot(computers: dict[str, Robot], name: str) -> None:
    """Start talkers, and subscribers of all talkers of the other computer."""
    ros = computers[name].ros
    for client in CLIENTS:
        ros.talker(client, f"/{name}_{client}", "--rate", "20", name=f"{name}_{client}_talker")
    computers[name].listeners = {
        f"{client} of {talker}": ros.listener(
            client, f"/{OTHER[name]}_{talker}", name=f"{name}_{client}_hears_{talker}"
        )
        for client in CLIENTS
        for talker in CLIENTS
    }


def loses_power(lab: Lab, computer: Robot) -> None:
    """Unplug a computer, so that no end of a connection is seen, and kill its nodes."""
    lab.unplug(computer.host)
    for process in computer.ros.processes:
        process.kill()
    for process in computer.ros.processes:
        process.stop()
    computer.ros.processes.clear()
    computer.listeners.clear()


def hear(computers: dict[str, Robot]) -> None:
    for computer in computers.values():
        computer.hears()


def loses_power_after(
    lab: Lab, computers: dict[str, Robot], appliance: Appliance, order: str, step: str
) -> None:
    """Give an order, and cut the second computer's power after a step of it; the order is still carried out."""
    process, wanted = appliance.process, f'"step": "{step}", "event": "adoption"'
    assert process is not None
    before = sum(wanted in line for line in [*process.errors])
    with computers["robot"].host.popen(
        [ROSRV, order, "--state", str(appliance.state)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as ordered:
        process.wait_for_error(wanted, count=before + 1, timeout=4 * LIMIT)
        loses_power(lab, computers["nuc"])
        said, _ = ordered.communicate(timeout=4 * LIMIT)
    assert ordered.returncode == 0, f"{order} {step}: {said}\n{appliance.story()}"
    lab.plug(computers["nuc"].host)


def test_the_second_computer_boots_later_and_reboots_alone(
    lab: Lab, computers: dict[str, Robot], appliance: Appliance, tmp_path: Path
) -> None:
    robot = computers["robot"]
    with PlainMaster(tmp_path, robot.host):
        boot(computers, "robot")
        rosrv(robot, appliance, "adopt")
        appliance.start()
        until_taken(robot, appliance)
        boot(computers, "nuc")
        hear(computers)
        loses_power(lab, computers["nuc"])
        lab.plug(computers["nuc"].host)
        boot(computers, "nuc")
        hear(computers)
        rosrv(robot, appliance, "release")
        hear(computers)


def test_the_second_computer_loses_its_power_while_the_graph_is_adopted_or_released(
    lab: Lab, computers: dict[str, Robot], appliance: Appliance, tmp_path: Path
) -> None:
    robot = computers["robot"]
    with PlainMaster(tmp_path, robot.host):
        boot(computers, "robot")
        boot(computers, "nuc")
        hear(computers)
        rosrv(robot, appliance, "adopt")
        appliance.start()
        until_taken(robot, appliance)
        for step in ("give", "withdraw", "tell"):
            loses_power_after(lab, computers, appliance, "release", step)
            boot(computers, "nuc")
            hear(computers)
            rosrv(robot, appliance, "adopt")
            hear(computers)
        rosrv(robot, appliance, "release")
        for step in ("register", "connect", "cut"):
            loses_power_after(lab, computers, appliance, "adopt", step)
            boot(computers, "nuc")
            hear(computers)
            rosrv(robot, appliance, "release")
            hear(computers)


@pytest.mark.parametrize("robot_first", [True, False])
def test_the_first_computer_reboots_alone(
    lab: Lab, computers: dict[str, Robot], appliance: Appliance, tmp_path: Path, *, robot_first: bool
) -> None:
    """Nodes of the second computer never register again: the appliance knows them from its stored state."""
    robot = computers["robot"]
    with ExitStack() as masters:
        masters.enter_context(PlainMaster(tmp_path, robot.host))
        boot(computers, "robot")
        boot(computers, "nuc")
        hear(computers)
        rosrv(robot, appliance, "adopt")
        appliance.start()
        until_taken(robot, appliance)
        hear(computers)
        loses_power(lab, robot)
        crash(appliance)
        masters.close()
        forget_the_boot(appliance)
        lab.plug(robot.host)
        if robot_first:
            masters.enter_context(PlainMaster(tmp_path, robot.host))
            boot(computers, "robot")
            appliance.start()
        else:
            appliance.start()
            boot(computers, "robot")
        until_taken(robot, appliance)
        hear(computers)
        rosrv(robot, appliance, "release")
        hear(computers)


def forget_the_boot(appliance: Appliance) -> None:
    """Make the record that of an earlier boot, and remove the rules, which no reboot leaves."""
    file = appliance.state / "adopt.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"boot": "earlier"}))
    with appliance.host.popen(["nft", "flush", "ruleset"]) as done:
        assert done.wait(LIMIT) == 0
