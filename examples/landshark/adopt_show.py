"""`rosrv demo --adopt`: a robot that drives is put behind the appliance, and given back, without a stop.

The exit status is 0 if an attack succeeded before and was denied after, no node ended, and the robot drove all the
time.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from examples.landshark.lab import Lab
from examples.landshark.results import Result
from examples.landshark.stage import ROBOT, START_SECONDS, Actor, DemoError, Stage

ATTACK = "spy on the position"
_ROSMASTER = ["/usr/bin/rosmaster", "--core", "-p", "11311"]
_LONGEST = 1.0  # seconds without odometry at the operator, on a machine that does much else
_ADOPTED_SECONDS = 60.0


class AdoptStage(Stage):
    """A robot with its own ROS master, its operator on another computer, and an attacker."""

    def __init__(self, lab: Lab, shipped: Path) -> None:
        super().__init__(lab, shipped, f"http://{ROBOT}:11311")

    def start_master(self) -> None:
        self._start(self.robot_host, "rosmaster", _ROSMASTER)

    def start_appliance(self) -> dict[str, object]:
        command = [sys.executable, "-m", "appliance.cli.main", "up", "--json", "--isolation", "netns"]
        command += ["--listen", "0.0.0.0:11311", "--policy", str(self.policy), "--state", str(self.state)]
        command += ["--monitors", str(self.monitors), "--enable", "none", "--api", "off"]
        return self._start(self.robot_host, "rosrv up", command).expect("ready")

    def on_robot(self, *arguments: str, check: bool = True) -> str:
        command = [sys.executable, "-m", "appliance.cli.main", *arguments, "--state", str(self.state)]
        with self.robot_host.popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            env=os.environ | {"NO_COLOR": "1"},
        ) as done:  # fmt: skip
            said, _ = done.communicate(timeout=2 * START_SECONDS)
        if check and done.returncode:
            raise DemoError(f"rosrv {' '.join(arguments)}: {said.strip()}")
        return str(said)

    def until_adopted(self) -> dict[str, object]:
        end = time.monotonic() + _ADOPTED_SECONDS
        while time.monotonic() < end:  # each query starts a process, so the loop needs no pause
            found: dict[str, object] = json.loads(self.on_robot("adopt", "--status", "--json"))
            if found["phase"] == "taken":
                return found
        raise DemoError(f"the robot was not adopted: {found['obstacle']}")


class AdoptShow:
    def __init__(self, stage: AdoptStage, console: Console) -> None:
        self.stage, self.console = stage, console
        self.results: list[Result] = []

    def run(self) -> bool:
        stage = self.stage
        self.headline(f"A robot works with its own ROS master ({ROBOT}), and its operator drives it")
        stage.start_master()
        nodes = stage.start_robot()
        operator = stage.start_operator()
        operator.expect("fired")
        operator.expect("position")
        self.say("its operator has driven and fired, and patrols")
        attack = stage.attack(ATTACK)
        self.result(f"any host may {ATTACK}", attack.succeeded, attack.answer[:60] or "done")
        self._adopt(operator)
        attack = stage.attack(ATTACK)
        self.result(f"the attacker may no longer {ATTACK}", not attack.succeeded, attack.answer[:100])
        self.headline("The robot is given back to its own master: rosrv release")
        for line in stage.on_robot("release").strip().splitlines():
            self.say(line)
        self._drives(operator, "released")
        dead = [actor.name for actor in [*nodes, operator] if not actor.running]
        self.result("no node ended", not dead, ", ".join(dead) or f"{len(nodes) + 1} nodes, none restarted")
        bad = sum(not result.good for result in self.results)
        self.headline(f"{len(self.results) - bad} of {len(self.results)} results as expected")
        return not bad

    def _adopt(self, operator: Actor) -> None:
        self.headline("The changes: rosrv adopt --check")
        for line in self.stage.on_robot("adopt", "--check").strip().splitlines():
            self.say(line)
        self.headline("The appliance takes the graph over while the robot drives: rosrv adopt")
        self.stage.on_robot("adopt")
        self.stage.start_appliance()
        found = self.stage.until_adopted()
        self.say(f"{found['nodes']} nodes use the appliance now")
        self._drives(operator, "adopted")

    def _drives(self, operator: Actor, when: str) -> None:
        """Compare two positions, and take the longest time in which the operator had no odometry."""
        events = list(operator.events.queue)
        gaps = [event["seconds"] for event in events if event and event.get("event") == "regained"]
        gap = max(gaps, default=0.0)
        before, after = operator.newest("position"), operator.newest("position")
        moved = before["x"] != after["x"] and gap < _LONGEST
        self.result(f"the robot drives on, {when}", moved, f"longest gap of its odometry: {gap or '< 0.3'} s")

    def result(self, what: str, good: bool, remark: str) -> None:
        self.results.append(Result(what, good, remark))
        colour = "green" if good else "bold red"
        self.console.print(
            f"  [{colour}]{'OK' if good else 'NOT OK':7}[/] {escape(what)}: {escape(remark)}",
            highlight=False,
            soft_wrap=True,
        )

    def headline(self, text: str) -> None:
        self.console.print(f"\n[bold]{escape(text)}[/]", soft_wrap=True)

    def say(self, text: str) -> None:
        self.console.print(f"  {escape(text)}", highlight=False, soft_wrap=True)
