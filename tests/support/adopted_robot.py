"""A running robot of unmodified nodes with its stock master, and what the tests of `rosrv adopt` look at in it."""

import itertools
import json
import os
import subprocess
from dataclasses import dataclass
from typing import Any

from examples.landshark.lab import Host
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.command import ROSRV
from tests.support.nodes import RosSession, numbers
from tests.support.processes import LIMIT, Process
from tests.support.rosmaster import call_on
from tests.support.waiting import eventually

URI = "http://127.0.0.1:11311"
POLICY = f"{OPEN_POLICY}\n[Options]\naudit-only = Publishers\n"


@dataclass
class Robot:
    host: Host
    ros: RosSession
    listeners: dict[str, Process]
    callers: dict[str, Process]

    def graph(self) -> list[list[tuple[str, list[str]]]]:
        state = call_on(self.host, URI, "getSystemState", "/test")[2]
        return [sorted((resource, sorted(nodes)) for resource, nodes in part) for part in state]

    def parameters(self) -> dict[str, Any]:
        found = call_on(self.host, URI, "getParam", "/test", "/")[2]
        return {name: value for name, value in found.items() if name not in {"rosdistro", "rosversion"}}

    def lives(self) -> set[int]:
        assert all(process.running for process in self.ros.processes), self.ros.story()
        return {process.pid for process in self.ros.processes}

    def hears(self) -> None:
        for listener in self.listeners.values():
            listener.wait_for_count(5, since=listener.mark(), event="received")

    def calls(self) -> dict[str, tuple[int, int]]:
        found = {}
        for name, caller in self.callers.items():
            since = caller.mark()
            caller.send("")
            event = caller.wait_for(since=since, event="counted")
            found[name] = event["good"], event["bad"]
        return found

    def losses(self) -> dict[str, tuple[int, int, int]]:
        """Return for each listener the messages lost, the longest gap, and the messages that came twice."""
        found = {}
        for name, listener in self.listeners.items():
            heard = numbers(listener.seen(event="received"))
            steps = [later - earlier for earlier, later in itertools.pairwise(heard)]
            lost = len(set(range(heard[0], heard[-1] + 1)) - set(heard))
            found[name] = lost, max(steps) - 1, len(heard) - len(set(heard))
        return found


def rosrv(robot: Robot, appliance: Appliance, *arguments: str, check: bool = True) -> str:
    command = [ROSRV, *arguments, "--state", str(appliance.state)]
    with robot.host.popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"NO_COLOR": "1"},
    ) as done:
        text, _ = done.communicate(timeout=2 * LIMIT)
    assert not check or done.returncode == 0, f"{text}\n{appliance.story()}"
    assert "\nnot cut: " not in text, text
    return str(text)


def crash(appliance: Appliance) -> None:
    """Kill the supervisor; its processes die with it."""
    assert appliance.process is not None
    appliance.process.kill()
    appliance.process.stop()


def adoption(robot: Robot, appliance: Appliance) -> dict[str, Any]:
    """Return the status of the adoption, without the notes before it."""
    found: dict[str, Any] = json.loads(
        rosrv(robot, appliance, "adopt", "--status", "--json").splitlines()[-1]
    )
    return found


def until_taken(robot: Robot, appliance: Appliance) -> None:
    def taken() -> bool:
        found = adoption(robot, appliance)
        assert not found["not_cut"], "a node keeps its connections"
        return bool(found["phase"] == "taken")

    eventually(taken, appliance.story)
