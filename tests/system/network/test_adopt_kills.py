"""Kill control in the middle of each step of an adoption and of a release: each subscriber hears its publishers again.

ROSRV_ADOPT_KILLS is the number of rounds over all steps; in each, the kill comes a little later after its step.
"""

import os
import random
import signal
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from examples.landshark.lab import Host
from tests.support.adopted_robot import Robot, adoption, rosrv, until_taken
from tests.support.appliance import Appliance
from tests.support.command import ROSRV
from tests.support.nodes import RosSession
from tests.support.processes import LIMIT
from tests.support.rosmaster import PlainMaster
from tests.support.waiting import eventually
from tests.system.network.test_adopt_nodes import (
    CLIENTS,
    Zoo,
    add_bonds,
    add_goals,
    add_nodelets,
    add_recording,
)

ROUNDS = int(os.environ.get("ROSRV_ADOPT_KILLS", "2"))
LATEST = 0.2  # seconds from a step to the kill
STEPS = {
    "release": (
        "silence",
        "stand in",
        "give",
        "withdraw",
        "give again",
        "tell",
        "given",
        "forget",
        "released",
    ),
    "adopt": ("read", "register", "forward", "connect", "tell", "cut", "read again", "hidden", "taken"),
}
ENDS = {"adopt": "taken", "release": "free"}

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(7200)]


@pytest.fixture
def zoo(host: Host, tmp_path: Path) -> Iterator[Zoo]:
    with PlainMaster(tmp_path, host), RosSession("http://localhost:11311", tmp_path, host) as ros:
        for client in CLIENTS:
            ros.talker(client, f"/{client}", "--rate", "50", name=f"{client}_talker")
        ros.service_server("rospy", "/rospy_go", name="rospy_server")
        listeners = {
            f"{client} of {topic}": ros.listener(client, f"/{topic}", name=f"{client}_of_{topic}")
            for client in CLIENTS
            for topic in CLIENTS
        }
        zoo = Zoo(host, ros, listeners, {}, tmp_path)
        for add in (add_nodelets, add_bonds, add_goals, add_recording):
            add(zoo)
        yield zoo


def rows(graph: list[list[tuple[str, list[str]]]]) -> set[tuple[int, str, str]]:
    return {(kind, name, node) for kind, part in enumerate(graph) for name, nodes in part for node in nodes}


def steps(appliance: Appliance, step: str) -> int:
    assert appliance.process is not None
    return sum(said(step) in line for line in [*appliance.process.errors])


def said(step: str) -> str:
    return f'"step": "{step}", "event": "adoption"'


def settled(robot: Robot, appliance: Appliance, phase: str) -> bool:
    try:
        status = adoption(robot, appliance)
    except AssertionError:  # control, which was killed, does not answer yet
        return False
    return bool(status["phase"] == phase and status["wanted"] == (phase == "taken"))


def kill_after(robot: Robot, appliance: Appliance, order: str, step: str, seconds: float) -> None:
    """Give an order, and kill control some seconds after a step of it."""
    control, before = appliance.pids("control")[0], steps(appliance, step)
    with robot.host.popen(
        [ROSRV, order, "--state", str(appliance.state)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as ordered:
        assert appliance.process is not None
        appliance.process.wait_for_error(said(step), count=before + 1, timeout=4 * LIMIT)
        with suppress(subprocess.TimeoutExpired):
            ordered.wait(seconds)
        os.kill(control, signal.SIGKILL)
        ordered.wait(4 * LIMIT)
    eventually(lambda: settled(robot, appliance, ENDS[order]), appliance.story)


def test_kills_of_control_after_each_step_leave_no_subscriber_deaf(zoo: Zoo, appliance: Appliance) -> None:
    """The relay, the rules and the supervisor stay, and the next control goes on as ordered."""
    eventually(lambda: "/record" in str(zoo.graph()), zoo.ros.story)
    zoo.goes_on()
    graph, lives = zoo.graph(), zoo.lives()
    rosrv(zoo, appliance, "adopt")
    appliance.start()
    until_taken(zoo, appliance)
    pause = random.Random(7)  # noqa: S311  pauses, no secrets
    for number in range(ROUNDS):
        for pair in zip(*STEPS.values(), strict=True):
            for order, step in zip(STEPS, pair, strict=True):
                seconds = pause.uniform(0, LATEST) if number else 0.0
                print(f"round {number}: a kill {seconds:.3f} s after {step} of {order}", flush=True)  # noqa: T201  shown by pytest -s
                kill_after(zoo, appliance, order, step, seconds)
                try:
                    zoo.goes_on()
                    assert rows(zoo.graph()) ^ rows(graph) == set()
                except BaseException as error:
                    error.add_note(
                        f"round {number}: control was killed {seconds:.3f} s after {step} of {order}"
                    )
                    raise
    assert zoo.lives() == lives
    print(zoo.figures())  # noqa: T201  shown by pytest -s
