"""What `rosrv demo` shows: the product at work, in about a minute.

A lab of four hosts on this machine: the appliance, a simulated LandShark of real ROS nodes, its operator,
and an attacker. The operator drives and fires; the attacker tries what ROS 1 lets anybody do; for each
the rule that decided is read from the audit log. At last the operator himself makes mistakes that no policy can
forbid, and monitors keep them from the robot. The exit status says whether the robot did what its
operator wanted and nothing else: scripts can rely on it.
"""

import shutil
import signal
import subprocess
import sys
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
from examples.landshark.doorway import Doorway
from examples.landshark.lab import Lab
from examples.landshark.mistakes import Mistakes, Ways
from examples.landshark.results import Result
from examples.landshark.stage import (
    ATTACKER,
    MASTER_URI,
    NODE_PYTHON,
    OPERATOR,
    ROBOT,
    Actor,
    Attack,
    DemoError,
    Stage,
)

RIGHTFUL = "watch the battery"  # what the policy lets the attacker's host do
AROUND = "go past the master"  # does not come to the appliance at all
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
# What the demonstration's nodes import, and its ROS Master.
_NODE_PACKAGES = (
    "rosmaster", "rospy", "genpy", "rosnode", "rosservice", "rostopic",
    "std_msgs", "geometry_msgs", "sensor_msgs", "nav_msgs",
)  # fmt: skip
Record = dict[str, Any]


class Show:
    """The demonstration, act by act; `results` is what the summary tells."""

    def __init__(self, stage: Stage, door: Doorway, console: Console) -> None:
        self.stage, self.door, self.console = stage, door, console
        self.results: list[Result] = []
        self.ways: Ways = {}
        self.last_sequence = -1
        self.robot: list[Actor] = []

    def run(self) -> bool:
        """All acts; whether everything was as it should be."""
        self.introduce()
        self.open()
        operator = self.mission()
        self.explain_grants()
        before = operator.newest("position")
        self.headline(
            f"An attacker has taken over the visitors' tablet ({ATTACKER}), which may watch the battery"
        )
        self.permit(self.stage.attack(RIGHTFUL))
        for name in ATTACKS:
            self.refuse(self.stage.attack(name))
        self.shut_out(self.stage.attack(AROUND))
        self.aftermath(operator, before)
        operator.stop()
        self.ways = Mistakes(self.stage, self).run()
        self.summary()
        return all(result.good for result in self.results)

    def introduce(self) -> None:
        """What is about to be seen, for who has never heard of it."""
        self.console.print(
            "ROS 1 trusts everyone who reaches its master. Here a robot stands behind the appliance, which decides\n"
            "every call by a policy. Four hosts are made on this machine, as network namespaces: the appliance, the\n"
            "robot, its operator, and an attacker. What each tries, what becomes of it, and the rule that decided:",
            highlight=False,
            soft_wrap=True,
        )

    def open(self) -> None:
        """The appliance, then the robot."""
        self.headline("The appliance takes the place of the ROS Master")
        ready = self.stage.start_appliance()
        self.say(f"nodes may connect: ROS_MASTER_URI={ready['master']}  (the real one is hidden)")
        self.say(f"policy:            {self.stage.policy}")
        self.say(
            f"console:           https://127.0.0.1:{self.door.port}/   (of this machine; its certificate is its own)"
        )
        self.say(f"token for it:      {ready['token']}")
        self.headline(f"A LandShark of unmodified ROS nodes starts ({ROBOT})")
        if not self.stage.make_radar():
            self.say("without its radar: the one roscpp node is compiled, with g++ and libroscpp-dev")
        self.robot = self.stage.start_robot()
        self.say(", ".join(actor.name for actor in self.robot))
        self.stage.protect_robot()
        self.say("its own ports answer the appliance only: rosrv protect --apply")

    def mission(self) -> Actor:
        """The operator drives, aims and fires."""
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
        """Why that was possible: four decisions out of the audit log."""
        granted = self.stage.audit("--allow", "--limit", "10000")
        for caller, topic in GRANTED:
            for record in granted:
                if (record.get("caller_id"), record.get("resource")) == (caller, topic):
                    self.decided("allowed", f"{record.get('category')} {topic} by {caller}", rule_of(record))
                    break
            else:
                self.results.append(Result(f"audit record: {caller} {topic}", good=False, remark="missing"))

    def permit(self, deed: Attack) -> None:
        """What the policy grants works, whoever it is that does it."""
        self.decided("allowed" if deed.succeeded else "REFUSED", f"{deed.name}: {deed.tried}", deed.answer)
        self.results.append(Result(deed.name, deed.succeeded, "granted by the policy"))

    def refuse(self, attack: Attack) -> None:
        """One attack and what became of it, with the rule from the audit log."""
        if attack.succeeded:
            self.decided("SUCCEEDED", f"{attack.name}: {attack.tried}", attack.answer)
            self.results.append(Result(f"attack: {attack.name}", good=False, remark=attack.answer))
            return
        record = self.record_of(attack)
        why = rule_of(record) if record else f"not in the audit log: {attack.answer}"
        self.decided("refused", f"{attack.name}: {attack.tried}", why)
        self.results.append(Result(f"attack: {attack.name}", good=record is not None, remark=why))

    def shut_out(self, attack: Attack) -> None:
        """The attack that goes around the appliance: the robot's own packet filter is to stop it."""
        outcome = "SUCCEEDED" if attack.succeeded else "refused"
        self.decided(outcome, f"{attack.name}: {attack.tried}", f"rosrv protect: {attack.answer}")
        self.results.append(Result(f"attack: {attack.name}", not attack.succeeded, attack.answer))

    def record_of(self, attack: Attack) -> Record | None:
        """The denial of this attack: a new record of what was tried, or the one that its answer repeats.

        The same denial, a moment later, is counted and not recorded a second time.
        """
        found = self.stage.audit("--deny", "--host", ATTACKER, "--limit", "1000")  # newest first
        denials = [one for one in found if one["event"] != "denials folded"]
        before, self.last_sequence = self.last_sequence, max((one["sequence"] for one in denials), default=-1)
        matching = [
            one
            for one in denials
            if (one["sequence"] > before and one.get("resource") and one["resource"] in attack.tried)
            or (one.get("reason") and one["reason"] in attack.answer)
        ]
        return next((one for one in matching if one.get("rule")), matching[0] if matching else None)

    def aftermath(self, operator: Actor, before: dict[str, Any]) -> None:
        """The robot is as it was: every node lives, it still drives, and nobody else fired."""
        self.headline("The robot did not notice")
        after = operator.newest("position")
        dead = [actor.name for actor in [*self.robot, operator] if not actor.running]
        moved = after["x"] != before["x"]
        place = f"now at {after['latitude']:.6f} {after['longitude']:.6f}"
        results = [
            Result("every node lives", not dead, ", ".join(dead) or f"{len(self.robot) + 1} nodes"),
            Result("the robot still drives", moved, place),
            Result("nobody else fired", after["shots"] == 1, f"{after['shots']} shot in all"),
        ]
        for result in results:
            self.say(f"{'' if result.good else 'NOT: '}{result.what}: {result.remark}")
        self.results += results

    def summary(self) -> None:
        """How much of it was as it should be, and what was not."""
        bad = [result for result in self.results if not result.good]
        self.headline(
            f"{len(self.results) - len(bad)} of {len(self.results)} as it should be"
            + ("" if bad else ": the robot obeyed its operator, and nobody else")
        )
        for result in bad:
            self.console.print(f"  [bold red]NOT OK[/] {escape(result.what)}: {escape(result.remark)}")

    def headline(self, text: str) -> None:
        """Begin an act."""
        self.console.print(f"\n[bold]{escape(text)}[/]", soft_wrap=True)

    def say(self, text: str) -> None:
        """One line of an act."""
        self.console.print(f"  {escape(text)}", highlight=False, soft_wrap=True)

    def decided(self, outcome: str, what: str, why: str) -> None:
        """One decision: the outcome, what was asked, and the rule."""
        colour = {"allowed": "green", "refused": "yellow"}.get(outcome, "bold red")
        line = f"  [{colour}]{outcome:9}[/] {escape(what)}\n            [dim]{escape(why)}[/]"
        self.console.print(line, highlight=False, soft_wrap=True)


def rule_of(record: Record) -> str:
    """The rule that decided, as the policy file has it; else the reason."""
    rule = record.get("rule")
    if not rule:
        return str(record.get("reason", ""))
    return f"[{rule['section']}] {rule['key']} ({Path(rule['file']).name}:{rule['line']})"


def require_everything() -> None:
    """Say what this machine lacks before anything is started."""
    if not has_privileges():
        raise DemoError(
            "the demonstration makes four hosts as network namespaces, which needs root: "
            "run it as root or with sudo, in a container with --cap-add SYS_ADMIN --cap-add NET_ADMIN"
        )
    imports = f"import {', '.join(_NODE_PACKAGES)}"
    if subprocess.run([NODE_PYTHON, "-c", imports], capture_output=True, check=False).returncode:
        packages = " ".join(f"python3-{name.replace('_', '-')}" for name in _NODE_PACKAGES)
        raise DemoError(f"ROS 1 is missing for {NODE_PYTHON}: sudo apt-get install rosout {packages}")


def demonstrate(*, hold: bool, picture: Path | None, as_json: bool) -> int:
    """Run the demonstration and tell it; `picture` is where the robot's ways are drawn. Returns the exit status."""
    console, errors = Console(stderr=as_json), Console(stderr=True)
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        require_everything()
        with ExitStack() as stack:
            lab = stack.enter_context(Lab("rosrv-demo"))
            stage = stack.enter_context(Stage(lab, SHIPPED))
            show = Show(stage, stack.enter_context(stage.console()), console)
            good = show.run()
            if as_json:
                for result in show.results:
                    say_json(asdict(result))
                sys.stdout.flush()
            if picture is not None:
                stage.draw(show.ways, picture)
                console.print(f"  {picture}: the robot's ways from above", soft_wrap=True)
            command = shutil.which("rosrv") or Path(sys.executable).with_name("rosrv")
            if not hold:
                console.print(
                    f"  {command} demo --hold    keeps it running, to look around in", soft_wrap=True
                )
                console.print("  docs/operating.md    how to put the appliance next to a robot of yours")
            else:
                console.print(
                    f"\nEverything keeps running until Ctrl-C: the master is {MASTER_URI} on these hosts.\n"
                    f"Console:          https://127.0.0.1:{show.door.port}/  (the token is above)\n"
                    f"Look at it:       {command} status --state {stage.state}\n"
                    f"                  {command} audit tail --deny --state {stage.state}\n"
                    f"Be the attacker:  ip netns exec {stage.attacker_host.namespace.name} "
                    f"env ROS_MASTER_URI={MASTER_URI} ROS_IP={ATTACKER} rostopic list",
                    soft_wrap=True,
                    highlight=False,
                )
                signal.pause()
    except KeyboardInterrupt:
        errors.print("\nEnded; everything is cleared away.")
        return 130
    except (DemoError, NetworkError) as error:
        errors.print(f"[red]rosrv demo:[/] {escape(str(error))}", soft_wrap=True)
        return 1
    return 0 if good else 1


def _interrupt(_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
