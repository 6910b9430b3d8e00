"""`rosrv demo --standby`: two appliances, of which the active one loses its power while the operator drives.

The exit status is 0 if the standby took over, no node ended, and both audit logs together prove the takeover.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from appliance.network import interfaces
from examples.landshark.lab import INTERFACE, Host, Lab
from examples.landshark.results import Result
from examples.landshark.stage import APPLIANCE, OPERATOR, ROBOT, START_SECONDS, Actor, DemoError, Stage

OTHER, FIXED = "10.77.0.3", "10.77.0.100"
LONGEST = 10.0  # seconds without the robot's odometry, on a machine that does much else
_SEARCH_SECONDS = 30.0


class StandbyStage(Stage):
    """A robot with two appliances, its operator, and the programs that grant and follow the lease."""

    def __init__(self, lab: Lab, shipped: Path) -> None:
        super().__init__(lab, shipped, f"http://{FIXED}:11311")
        self.appliances = [APPLIANCE, OTHER]
        self.other_host = lab.host("standby", f"{OTHER}/24")
        self.other_state = self.directory / "other-state"
        self.kit = self.directory / "kit"

    def join(self) -> None:
        """Make the pair, and start the witness and a follower as the services of their kits do."""
        first = ["--address", APPLIANCE, "--other", OTHER, "--witness", ROBOT, "--fixed", FIXED]
        first += ["--follower", f"ocu={OPERATOR}", "--ports", "11311,19001-26000", "--output", str(self.kit)]
        self.rosrv("standby", "join", *first, "--state", str(self.state))
        self.rosrv("standby", "join", str(self.kit / "standby-b.json"), "--state", str(self.other_state))
        for folder, host, verb in (
            ("witness", self.robot_host, "serve"),
            ("follower-ocu", self.operator_host, "follow"),
        ):
            program = [sys.executable, "-I", str(self.kit / folder / "witness.py")]
            settings = ["--settings", str(self._settings(folder))]
            if verb == "serve":
                begin = [*program, "begin", *settings, "--in-sync", "a", "--epoch", "1"]
                done = host.popen(begin, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
                said, _ = done.communicate(timeout=START_SECONDS)
                if done.returncode:
                    raise DemoError(f"the witness has no lease: {said.strip()}")
            self._start(host, folder, [*program, verb, *settings])

    def _settings(self, folder: str) -> Path:
        """Keep the lease's file in the demonstration's folder instead of /var, and return the settings."""
        path = self.kit / folder / "witness.json"
        settings = json.loads(path.read_text()) | {"state": str(self.directory / f"{folder}-lease")}
        path.write_text(json.dumps(settings))
        return path

    def standby(self, state: Path) -> dict[str, Any]:
        command = [sys.executable, "-m", "appliance.cli.main", "standby", "status", "--json"]
        done = subprocess.run(
            [*command, "--state", str(state)],
            capture_output=True,
            text=True,
            timeout=START_SECONDS,
            check=False,
        )
        found: dict[str, Any] = json.loads(done.stdout) if done.stdout.strip() else {}
        return found

    def until(self, state: Path, **wanted: object) -> None:
        """Wait for this status; each query starts a process, so the loop needs no pause."""
        end = time.monotonic() + _SEARCH_SECONDS
        while time.monotonic() < end:
            seen = self.standby(state)
            if all({**seen, **seen.get("other", {})}.get(key) == value for key, value in wanted.items()):
                return
        raise DemoError(f"rosrv standby status never had {wanted}: {self.standby(state)}")

    def cut_power(self, host: Host) -> None:
        interfaces.set_link(host.namespace, INTERFACE, up=False)
        for pid in host.namespace.processes():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


class StandbyShow:
    def __init__(self, stage: StandbyStage, console: Console) -> None:
        self.stage, self.console = stage, console
        self.results: list[Result] = []

    def run(self) -> bool:
        stage = self.stage
        self.headline("Two appliances become a pair: rosrv standby join")
        stage.join()
        self.say(
            f"a ({APPLIANCE}), b ({OTHER}); the robot's nodes use {FIXED}, which its firewall translates"
        )
        active = stage.run_appliance(stage.appliance_host, "rosrv up", stage.state)
        active.expect("ready")
        stage.run_appliance(stage.other_host, "rosrv up (b)", stage.other_state).expect("standby")
        stage.until(stage.state, in_sync=True)
        self.say("a is active, b is in sync")
        nodes = self._start_robot()
        operator = stage.start_operator()
        operator.expect("fired")
        operator.expect("position")
        self.say("its operator has driven and fired, and patrols")
        self._cut(operator, nodes)
        self._prove()
        good = all(result.good for result in self.results)
        bad = sum(not result.good for result in self.results)
        self.headline(f"{len(self.results) - bad} of {len(self.results)} results as expected")
        return good

    def _start_robot(self) -> list[Actor]:
        self.headline("A LandShark of unmodified ROS nodes starts")
        if not self.stage.make_radar():
            self.say("without its radar, a roscpp node that needs g++ and libroscpp-dev to compile")
        nodes = self.stage.start_robot()
        self.stage.protect_robot()
        self.say(", ".join(actor.name for actor in nodes))
        return nodes

    def _cut(self, operator: Actor, nodes: list[Actor]) -> None:
        self.headline("The active appliance loses its power while the operator drives")
        self.stage.cut_power(self.stage.appliance_host)
        operator.expect("lost")
        seconds = operator.expect("regained")["seconds"]
        self.stage.until(self.stage.other_state, role="active")
        self.result(
            "the operator has the robot again", seconds < LONGEST, f"after {seconds} s without odometry"
        )
        after = operator.newest("position")
        later = operator.newest("position")
        self.result(
            "the robot still drives", after["x"] != later["x"], f"x {after['x']:.2f}, {later['x']:.2f} m"
        )
        dead = [actor.name for actor in [*nodes, operator] if not actor.running]
        self.result("no node ended", not dead, ", ".join(dead) or f"{len(nodes) + 1} nodes")

    def _prove(self) -> None:
        self.headline("Both audit logs together prove the takeover: rosrv audit verify")
        try:
            said = self.stage.rosrv(
                "audit", "verify", "--state", str(self.stage.other_state), "--other", str(self.stage.state)
            )
        except DemoError as error:
            self.result("the logs prove the takeover", False, str(error))
            return
        self.result("the logs prove the takeover", True, said.strip().splitlines()[-1])

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
