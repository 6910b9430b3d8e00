"""`rosrv demo`: the appliance at work, in about a minute.

A lab on this machine has four hosts: the appliance, a simulated LandShark of real ROS nodes, its operator, and an
attacker, who tries everything that ROS 1 allows any host to do. The exit status is 0 if the robot obeyed only its
operator.
"""

import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from types import FrameType
from typing import Any

from rich.console import Console
from rich.markup import escape

from appliance.base.shipped import SHIPPED
from appliance.cli.output import say_json
from appliance.network.namespaces import NetworkError, has_privileges
from examples.landshark.adopt_show import AdoptShow, AdoptStage
from examples.landshark.doorway import Doorway
from examples.landshark.lab import Lab
from examples.landshark.mistakes import Mistakes, Ways
from examples.landshark.results import Result
from examples.landshark.runaways import Runaways
from examples.landshark.stage import (
    ATTACKER,
    MASTER_URI,
    NODE_PYTHON,
    OPERATOR,
    ROBOT,
    Actor,
    Attack,
    DemoError,
    Record,
    Stage,
)
from examples.landshark.standby_show import StandbyShow, StandbyStage

PERMITTED = "watch the battery"  # the policy allows this to the attacker's host
BYPASS = "go past the master"  # bypasses the appliance
ATTACKS = (
    "look around",
    "take over the operator",
    "forge the trigger",
    "replace a driver",
    "spy on the position",
    "kill a node",
    "try every port",
    "stop the clock",
    "wipe the parameters",
    "stop the master",
)
GRANTED = (
    ("/landshark_base", "/landshark/odom"),
    ("/ocu", "/landshark/gps"),
    ("/ocu", "/landshark_control/base_velocity"),
    ("/ocu", "/landshark_control/trigger"),
)
# Bytes: the reserve of the audit log, 64 MiB, with some room above it, and the state of two appliances, 40 MiB each.
_SPACE = 160 << 20
# Packages that the demonstration's nodes and its ROS master import.
_NODE_PACKAGES = (
    "rosmaster", "rospy", "genpy", "rosnode", "rosservice", "rostopic",
    "std_msgs", "geometry_msgs", "sensor_msgs", "nav_msgs",
)  # fmt: skip


class Show:
    """The acts of the demonstration, in order. `results` collects the outcomes for the summary."""

    def __init__(self, stage: Stage, door: Doorway, console: Console) -> None:
        self.stage, self.door, self.console = stage, door, console
        self.results: list[Result] = []
        self.ways: Ways = {}
        self.last_sequence = -1
        self.robot: list[Actor] = []

    def run(self) -> bool:
        self.introduce()
        self.open()
        operator = self.mission()
        self.explain_grants()
        before = operator.newest("position")
        self.headline(
            f"An attacker has taken over the visitors' tablet ({ATTACKER}), which may watch the battery"
        )
        self.expect_allowed(self.stage.attack(PERMITTED))
        for name in ATTACKS:
            self.expect_denied(self.stage.attack(name))
        self.expect_blocked(self.stage.attack(BYPASS))
        self.aftermath(operator, before)
        operator.stop()
        self.ways = {**Mistakes(self.stage, self).run(), **Runaways(self.stage, self).run()}
        self.summary()
        return all(result.good for result in self.results)

    def introduce(self) -> None:
        self.console.print(
            "ROS 1 trusts everyone who reaches its master. Here the appliance protects a robot and decides every call\n"
            "by a policy. The demo creates four hosts as network namespaces here: the appliance, the robot,\n"
            "its operator, and an attacker. Each line shows an attempt, its outcome, and the deciding rule:",
            highlight=False,
            soft_wrap=True,
        )

    def open(self) -> None:
        self.headline("The appliance takes the place of the ROS master")
        ready = self.stage.start_appliance()
        self.say(f"nodes may connect: ROS_MASTER_URI={ready['master']}  (the real one is hidden)")
        self.say(f"policy:            {self.stage.policy}")
        self.say(
            f"console:           https://127.0.0.1:{self.door.port}/   (on this machine; self-signed certificate)"
        )
        self.say(f"its token:         {ready['token']}")
        self.headline(f"A LandShark of unmodified ROS nodes starts ({ROBOT})")
        if not self.stage.make_radar():
            self.say("without its radar, a roscpp node that needs g++ and libroscpp-dev to compile")
        self.robot = self.stage.start_robot()
        self.say(", ".join(actor.name for actor in self.robot))
        self.stage.protect_robot()
        self.say("its own ports answer only the appliance: rosrv protect --apply")

    def mission(self) -> Actor:
        self.headline(f"Its operator takes the controls ({OPERATOR})")
        operator = self.stage.start_operator()
        operator.expect("connected")
        drove = operator.expect("drove")
        self.results.append(Result("the robot drives", drove["metres"] >= 3, f"{drove['metres']} m"))
        self.say(f"drove {drove['metres']} m")
        aimed = operator.expect("aimed")
        self.say(f"aimed the gun: tilt {aimed['tilt']:.2f} rad")
        fired = operator.expect("fired")
        self.results.append(Result("the gun fires for its operator", fired["shots"] == 1, "1 shot"))
        self.say("fired one shot")
        return operator

    def explain_grants(self) -> None:
        for caller, topic in GRANTED:
            named = ("--allow", "--caller", caller, "--topic", topic, "--limit", "1")
            record = self.stage.recorded(lambda found: next(iter(found), None), *named)
            if record is None:
                self.results.append(Result(f"audit record: {caller} {topic}", good=False, remark="missing"))
            else:
                self.decided("allowed", f"{record.get('category')} {topic} by {caller}", rule_of(record))

    def expect_allowed(self, attempt: Attack) -> None:
        outcome = "allowed" if attempt.succeeded else "DENIED"
        self.decided(outcome, f"{attempt.name}: {attempt.tried}", attempt.answer)
        self.results.append(Result(attempt.name, attempt.succeeded, "granted by the policy"))

    def expect_denied(self, attack: Attack) -> None:
        """Print an attack with the rule that denied it, from the audit log."""
        if attack.succeeded:
            self.decided("SUCCEEDED", f"{attack.name}: {attack.tried}", attack.answer)
            self.results.append(Result(f"attack: {attack.name}", good=False, remark=attack.answer))
            return
        record = self.record_of(attack)
        why = rule_of(record) if record else f"not in the audit log: {attack.answer}"
        self.decided("denied", f"{attack.name}: {attack.tried}", why)
        self.results.append(Result(f"attack: {attack.name}", good=record is not None, remark=why))

    def expect_blocked(self, attack: Attack) -> None:
        """Print an attack that bypasses the appliance, so that only the robot's own packet filter can block it."""
        outcome = "SUCCEEDED" if attack.succeeded else "blocked"
        self.decided(outcome, f"{attack.name}: {attack.tried}", f"rosrv protect: {attack.answer}")
        self.results.append(Result(f"attack: {attack.name}", not attack.succeeded, attack.answer))

    def record_of(self, attack: Attack) -> Record | None:
        """Return the denial of an attack: a new record of its resource, or the one whose reason the answer repeats."""
        before = self.last_sequence

        def find(records: list[Record]) -> Record | None:
            denials = [record for record in records if record["event"] != "denials folded"]
            self.last_sequence = max((denial["sequence"] for denial in denials), default=before)
            matching = [
                one
                for one in denials
                if (one["sequence"] > before and one.get("resource") and one["resource"] in attack.tried)
                or (one.get("reason") and one["reason"] in attack.answer)
            ]
            return next((one for one in matching if one.get("rule")), matching[0] if matching else None)

        return self.stage.recorded(find, "--deny", "--host", ATTACKER, "--limit", "1000")

    def aftermath(self, operator: Actor, before: dict[str, Any]) -> None:
        self.headline("The robot is unaffected")
        after = operator.newest("position")
        dead = [actor.name for actor in [*self.robot, operator] if not actor.running]
        moved = after["x"] != before["x"]
        place = f"now at {after['latitude']:.6f} {after['longitude']:.6f}"
        results = [
            Result("every node is alive", not dead, ", ".join(dead) or f"{len(self.robot) + 1} nodes"),
            Result("the robot still drives", moved, place),
            Result("only the operator fired", after["shots"] == 1, f"{after['shots']} shot in total"),
        ]
        for result in results:
            self.say(f"{'' if result.good else 'NOT: '}{result.what}: {result.remark}")
        self.results += results

    def summary(self) -> None:
        bad = [result for result in self.results if not result.good]
        self.headline(
            f"{len(self.results) - len(bad)} of {len(self.results)} results as expected"
            + ("" if bad else ": the robot obeyed only its operator")
        )
        for result in bad:
            self.console.print(f"  [bold red]NOT OK[/] {escape(result.what)}: {escape(result.remark)}")

    def headline(self, text: str) -> None:
        self.console.print(f"\n[bold]{escape(text)}[/]", soft_wrap=True)

    def say(self, text: str) -> None:
        self.console.print(f"  {escape(text)}", highlight=False, soft_wrap=True)

    def decided(self, outcome: str, what: str, why: str) -> None:
        colour = {"allowed": "green", "denied": "yellow", "blocked": "yellow"}.get(outcome, "bold red")
        line = f"  [{colour}]{outcome:9}[/] {escape(what)}\n            [dim]{escape(why)}[/]"
        self.console.print(line, highlight=False, soft_wrap=True)


def rule_of(record: Record) -> str:
    rule = record.get("rule")
    if not rule:
        return str(record.get("reason", ""))
    return f"[{rule['section']}] {rule['key']} ({Path(rule['file']).name}:{rule['line']})"


def require_everything() -> None:
    if not has_privileges():
        raise DemoError(
            "the demonstration creates four hosts as network namespaces, which needs root: "
            "run it with sudo, or in a container with --cap-add SYS_ADMIN --cap-add NET_ADMIN"
        )
    folder = tempfile.gettempdir()
    if (free := shutil.disk_usage(folder).free) < _SPACE:
        raise DemoError(
            f"the demonstration needs {_SPACE >> 20} MiB in {folder}, where {free >> 20} MiB are free: free disk space "
            "there, or set TMPDIR to another folder, such as TMPDIR=/var/tmp"
        )
    imports = f"import {', '.join(_NODE_PACKAGES)}"
    if subprocess.run([NODE_PYTHON, "-c", imports], capture_output=True, check=False).returncode:
        packages = " ".join(f"python3-{name.replace('_', '-')}" for name in _NODE_PACKAGES)
        raise DemoError(f"ROS 1 is missing for {NODE_PYTHON}: sudo apt-get install rosout {packages}")


def demonstrate(
    *, hold: bool, picture: Path | None, as_json: bool, standby: bool = False, adopt: bool = False
) -> int:
    """Return the exit status. Draw the robot's paths into the file `picture`."""
    console, errors = Console(stderr=as_json), Console(stderr=True)
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        require_everything()
        with ExitStack() as stack:
            lab = stack.enter_context(Lab("rosrv-demo"))
            if adopt:
                return _show_adopt(stack.enter_context(AdoptStage(lab, SHIPPED)), console, hold, as_json)
            if standby:
                return _show_standby(stack.enter_context(StandbyStage(lab, SHIPPED)), console, hold, as_json)
            stage = stack.enter_context(Stage(lab, SHIPPED))
            show = Show(stage, stack.enter_context(stage.console()), console)
            good = show.run()
            _print_results(show.results, as_json)
            if picture is not None:
                stage.draw(show.ways, picture)
                console.print(f"  {picture}: the robot's paths from above", soft_wrap=True)
            command = shutil.which("rosrv") or Path(sys.executable).with_name("rosrv")
            if not hold:
                console.print(
                    f"  {command} demo --keep    keeps everything running for you to explore", soft_wrap=True
                )
                console.print("  docs/install.md    how to put the appliance beside your robot")
            else:
                console.print(
                    f"\nEverything keeps running until Ctrl-C: the master is {MASTER_URI} on these hosts.\n"
                    f"Console:          https://127.0.0.1:{show.door.port}/  (the token is above)\n"
                    f"Explore:          {command} status --state {stage.state}\n"
                    f"                  {command} audit tail --deny --state {stage.state}\n"
                    f"Be the attacker:  ip netns exec {stage.attacker_host.namespace.name} "
                    f"env ROS_MASTER_URI={MASTER_URI} ROS_IP={ATTACKER} rostopic list",
                    soft_wrap=True,
                    highlight=False,
                )
                signal.pause()
    except KeyboardInterrupt:
        errors.print("\nInterrupted; everything is removed.")
        return 130
    except (DemoError, NetworkError) as error:
        errors.print(f"[red]rosrv demo:[/] {escape(str(error))}", soft_wrap=True)
        return 1
    return 0 if good else 1


def _show_standby(stage: StandbyStage, console: Console, hold: bool, as_json: bool) -> int:
    show = StandbyShow(stage, console)
    good = show.run()
    _print_results(show.results, as_json)
    if hold:
        command = shutil.which("rosrv") or Path(sys.executable).with_name("rosrv")
        console.print(
            f"\nEverything keeps running until Ctrl-C, with b as the active appliance.\n"
            f"Explore:  {command} standby status --state {stage.other_state}\n"
            f"          {command} status --state {stage.other_state}",
            soft_wrap=True,
            highlight=False,
        )
        signal.pause()
    return 0 if good else 1


def _show_adopt(stage: AdoptStage, console: Console, hold: bool, as_json: bool) -> int:
    show = AdoptShow(stage, console)
    good = show.run()
    _print_results(show.results, as_json)
    if hold:
        command = shutil.which("rosrv") or Path(sys.executable).with_name("rosrv")
        inside = f"ip netns exec {stage.robot_host.namespace.name}"
        console.print(
            f"\nEverything keeps running until Ctrl-C.\n"
            f"Adopt it again:  {inside} {command} adopt --state {stage.state}\n"
            f"Release it:      {inside} {command} release --state {stage.state}",
            soft_wrap=True,
            highlight=False,
        )
        signal.pause()
    return 0 if good else 1


def _print_results(results: Sequence[Result], as_json: bool) -> None:
    if as_json:
        for result in results:
            say_json(asdict(result))
        sys.stdout.flush()


def _interrupt(_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
