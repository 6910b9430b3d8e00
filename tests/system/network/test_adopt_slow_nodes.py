"""Adopt nodes that lag behind, or answer late: time never goes back in them, and none is silent afterwards."""

import itertools
import json
import os
import signal
from pathlib import Path

import pytest

from examples.landshark.lab import Host
from tests.support.adopted_robot import Robot, crash, rosrv, until_taken
from tests.support.appliance import Appliance
from tests.support.nodes import Client, RosSession, numbers
from tests.support.processes import Process
from tests.support.rosmaster import PlainMaster
from tests.support.waiting import eventually

CHANGES = int(os.environ.get("ROSRV_CLOCK_CHANGES", "6"))

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(1800)]


def test_time_never_goes_back_in_a_node_that_lags_behind(
    host: Host, tmp_path: Path, appliance: Appliance
) -> None:
    """After the cut of a connection, its node reads on what its kernel had received."""
    with PlainMaster(tmp_path, host), RosSession("http://localhost:11311", tmp_path, host) as ros:
        ros.run("rosparam", "set", "/use_sim_time", "true")
        ros.node("rospy", "sim_clock", name="clock")
        sleepers = [ros.node("rospy", "sleeper", "--stutter", name=f"stutters_{number}") for number in (1, 2)]
        sleepers += [ros.node(client, "sleeper", name=f"{client}_sleeper") for client in ("rospy", "roscpp")]
        robot = Robot(host, ros, {}, {})
        rosrv(robot, appliance, "adopt")
        appliance.start()
        until_taken(robot, appliance)
        _require_time(sleepers)
        for number in range(1, CHANGES):
            print(rosrv(robot, appliance, "release" if number % 2 else "adopt").splitlines()[0])  # noqa: T201  shown by pytest -s
            _require_time(sleepers)
        for sleeper in sleepers:
            times = [event["now"] for event in sleeper.seen(event="slept")]
            steps = [later - earlier for earlier, later in itertools.pairwise(times)]
            print("longest sleep of 0.1 s:", max(steps))  # noqa: T201  shown by pytest -s
            assert min(steps) >= 0


def test_time_never_goes_back_at_a_start_beside_an_adopted_robot(
    host: Host, tmp_path: Path, appliance: Appliance
) -> None:
    """After a crash of the whole appliance, of a relay, and of control."""
    with PlainMaster(tmp_path, host), RosSession("http://localhost:11311", tmp_path, host) as ros:
        ros.run("rosparam", "set", "/use_sim_time", "true")
        ros.node("rospy", "sim_clock", name="clock")
        sleepers = [ros.node("rospy", "sleeper", "--stutter", name=f"stutters_{number}") for number in (1, 2)]
        sleepers += [ros.node(client, "sleeper", name=f"{client}_sleeper") for client in ("rospy", "roscpp")]
        robot = Robot(host, ros, {}, {})
        rosrv(robot, appliance, "adopt")
        appliance.start()
        until_taken(robot, appliance)
        for _ in range(CHANGES // 3):
            _require_time(sleepers)
            crash(appliance)
            appliance.start()
            until_taken(robot, appliance)
            _require_time(sleepers)
            for role in ("relay", "control"):
                _kill(appliance, role)
                until_taken(robot, appliance)
                _require_time(sleepers)


def _kill(appliance: Appliance, role: str) -> None:
    killed = appliance.kill(role)
    eventually(lambda: killed not in appliance.pids(role), appliance.story)


def _require_time(sleepers: list[Process]) -> None:
    for sleeper in sleepers:
        sleeper.wait_for_count(5, since=sleeper.mark(), event="slept")
        assert sleeper.running
        assert not sleeper.seen(event="back"), "time never goes back"


@pytest.mark.parametrize("late", [4, 8])
def test_a_publisher_that_tells_its_port_late_is_cut_and_heard(
    host: Host, tmp_path: Path, appliance: Appliance, late: int
) -> None:
    with PlainMaster(tmp_path, host), RosSession("http://localhost:11311", tmp_path, host) as ros:
        talker = ros.talker("rospy", "/late", "--late", str(late), name="late_talker")
        listeners = {
            client: ros.listener(client, "/late", name=f"{client}_listener") for client in ("rospy", "roscpp")
        }
        robot = Robot(host, ros, listeners, {})
        robot.hears()
        rosrv(robot, appliance, "adopt")
        appliance.start()
        until_taken(robot, appliance)
        eventually(
            lambda: len(json.loads(rosrv(robot, appliance, "topic", "info", "/late", "--json"))["connections"]) == 2,
            appliance.story,
        )  # fmt: skip
        for listener in listeners.values():
            heard = numbers(listener.wait_for_count(20, since=listener.mark(), event="received"))
            assert len(heard) == len(set(heard)), "no connection goes from node to node"
        assert talker.running


@pytest.mark.parametrize("client", ["rospy", "roscpp"])
def test_a_start_takes_nothing_until_each_node_of_this_computer_answers(
    host: Host, tmp_path: Path, appliance: Appliance, client: Client
) -> None:
    """A node without a connection to its master would be left out: both clients keep theirs."""
    with PlainMaster(tmp_path, host), RosSession("http://localhost:11311", tmp_path, host) as ros:
        talker = ros.talker(client, "/stopped", name="stopped")
        robot = Robot(host, ros, {"listener": ros.listener("roscpp", "/stopped", name="listener")}, {})
        robot.hears()
        rosrv(robot, appliance, "adopt")
        graph = robot.graph()
        os.kill(talker.pid, signal.SIGSTOP)
        appliance.start()
        why = "1 node of this computer cannot be called: /stopped"
        eventually(lambda: why in rosrv(robot, appliance, "adopt", "--status"), appliance.story)
        assert "use their own master" in rosrv(robot, appliance, "adopt", "--status")
        assert robot.graph() == graph
        os.kill(talker.pid, signal.SIGCONT)
        until_taken(robot, appliance)
        robot.hears()
        assert robot.graph() == graph
