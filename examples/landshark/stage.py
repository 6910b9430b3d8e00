"""Run the actors of the demonstration: a simulated LandShark, its operator and an attacker, each on a host of a lab.

The nodes know the appliance only as ROS_MASTER_URI.
"""

import contextlib
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from appliance.base.shipped import IS_CHECKOUT
from examples.landshark.doorway import Doorway
from examples.landshark.lab import Host, Lab

NODE_PYTHON = "/usr/bin/python3"  # Debian's Python, for which rospy is installed
APPLIANCE, ROBOT, OPERATOR, ATTACKER = "10.77.0.2", "10.77.0.10", "10.77.0.20", "10.77.0.66"
MASTER_URI = f"http://{APPLIANCE}:11311"
CONSOLE = ("127.0.0.1", 8443)  # on the appliance's host
START_SECONDS = 180.0  # the limit for the start of an appliance or a node, on a slow machine under load
ATTACK_SECONDS = 60.0
_NO_COMPILER = 3  # exit status of scripts/build-roscpp
RECORD_SECONDS = 20.0  # the log writes a record within 50 ms, unless the disk is slow
COMMAND_SECONDS = 120.0  # long enough for a drive through the yard, and the starts before it

Event = dict[str, Any]
Record = dict[str, Any]


class DemoError(RuntimeError):
    """The demonstration cannot continue. The text has the reason, and where possible the end of a log."""


@dataclass(frozen=True)
class Attack:
    name: str
    tried: str
    answer: str
    succeeded: bool


class Actor:
    """A process on a host that prints one JSON object per line. Its other output goes to the file `log`."""

    def __init__(
        self, host: Host, name: str, command: list[str], environment: dict[str, str], log: Path
    ) -> None:
        self.host, self.name, self.log = host, name, log
        self.events: queue.Queue[Event | None] = queue.Queue()
        self._log = log.open("a")
        self.process = host.popen(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
            errors="backslashreplace",
            start_new_session=True,  # Ctrl-C is only for the demonstration, which ends its actors itself
        )
        self._reader = threading.Thread(target=self._read, name=f"{name} output", daemon=True)
        self._reader.start()

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def expect(self, event: str, seconds: float = START_SECONDS) -> Event:
        """Wait for an event, and skip all before it. Raise `DemoError` if the process ends or the time has passed."""
        deadline = time.monotonic() + seconds
        while True:
            try:
                said = self.events.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise self._failure(f"did not say {event!r} within {seconds:.0f} s") from None
            if said is None:
                raise self._failure(f"ended with status {self.process.wait()} before it said {event!r}")
            if said.get("event") == event:
                return said

    def newest(self, event: str, seconds: float = START_SECONDS) -> Event:
        """Wait for an event that is reported after this call."""
        with contextlib.suppress(queue.Empty):
            while True:
                if self.events.get_nowait() is None:
                    self.events.put(None)
                    break
        return self.expect(event, seconds)

    def interrupt(self) -> None:
        if self.running:
            self.process.send_signal(signal.SIGTERM)

    def stop(self, seconds: float = 6.0) -> None:
        """End the process with SIGTERM, and after some seconds with SIGKILL."""
        if self.running:
            self.interrupt()
            try:
                self.process.wait(seconds)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self._reader.join(seconds)
        self._log.close()

    def _read(self) -> None:
        output = self.process.stdout
        assert output is not None
        for line in output:
            with contextlib.suppress(ValueError):
                said = json.loads(line)
                if isinstance(said, dict):
                    self.events.put(said)
                    continue
            self._log.write(line)
        output.close()
        self.events.put(None)

    def _failure(self, what: str) -> DemoError:
        self._log.flush()
        words = self.log.read_text(errors="backslashreplace").strip().splitlines()[-8:]
        return DemoError("\n  ".join([f"{self.name} on {self.host.name} {what}", *words]))


class Stage:
    """The hosts of the demonstration and the programs on them. Leaving the block ends all programs."""

    def __init__(self, lab: Lab, shipped: Path, master: str = MASTER_URI) -> None:
        """Make the hosts. Nodes get `master` as their ROS_MASTER_URI."""
        self.master = master
        self.appliances = [APPLIANCE]
        self.shipped = shipped
        self.nodes = shipped / "examples" / "landshark" / "nodes"
        self.policy = shipped / "examples" / "landshark" / "landshark-demo.ini"
        self.directory = Path(tempfile.mkdtemp(prefix="rosrv-demo-"))
        self.directory.chmod(0o755)  # the appliance's processes run as other users
        # A copy, because `rosrv guard new` writes into the folder of specifications.
        self.monitors = shutil.copytree(shipped / "monitors", self.directory / "monitors")
        self.state = self.directory / "state"
        self._radar: Path | None = None
        self._lab = lab
        self.appliance_host = lab.host("appliance", f"{APPLIANCE}/24")
        self.robot_host = lab.host("robot", f"{ROBOT}/24")
        self.operator_host = lab.host("ocu", f"{OPERATOR}/24")
        self.attacker_host = lab.host("attacker", f"{ATTACKER}/24")
        self.actors: list[Actor] = []

    def start_appliance(self) -> Event:
        return self.run_appliance(self.appliance_host, "rosrv up", self.state).expect("ready")

    def run_appliance(self, host: Host, name: str, state: Path) -> Actor:
        command = [sys.executable, "-m", "appliance.cli.main", "up", "--json", "--isolation", "container"]
        command += [
            "--listen",
            f"{host.address}:11311",
            "--policy",
            str(self.policy),
            "--monitors",
            str(self.monitors),
            "--enable",
            "none",
            "--state",
            str(state),
            "--api",
            f"{CONSOLE[0]}:{CONSOLE[1]}",
        ]
        return self._start(host, name, command)

    def start_robot(self) -> list[Actor]:
        """Start five rospy nodes, and one roscpp node if it was compiled."""
        python = {
            "base": ["base.py"],
            "turret": ["turret.py"],
            "gps": ["sensors.py", "gps"],
            "laser": ["sensors.py", "laser"],
            "battery": ["sensors.py", "battery"],
        }
        commands = {
            name: [NODE_PYTHON, str(self.nodes / file), *arguments]
            for name, (file, *arguments) in python.items()
        }
        if self._radar is not None:
            commands["radar"] = [str(self._radar)]
        return [
            self._start(self.robot_host, f"landshark_{name}", command) for name, command in commands.items()
        ]

    def make_radar(self) -> bool:
        """Compile the roscpp node, or return False if there is no compiler."""
        # A checkout compiles it once; an installed package is never written to.
        program = (self.shipped / "build" if IS_CHECKOUT else self.directory) / "landshark_radar"
        build = self.shipped / "scripts" / "build-roscpp"
        command = ["bash", str(build), str(self.nodes / "radar.cpp"), str(program)]
        built = subprocess.run(command, capture_output=True, text=True, check=False)
        if built.returncode == _NO_COMPILER:
            return False
        if built.returncode:
            raise DemoError(f"the radar node could not be compiled:\n{built.stderr.strip()}")
        self._radar = program
        return True

    def protect_robot(self) -> None:
        command = [sys.executable, "-m", "appliance.cli.main", "protect", "--apply"]
        for address in self.appliances:
            command += ["--appliance", address]
        protect = self.robot_host.popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        said, _ = protect.communicate(timeout=START_SECONDS)
        if protect.returncode:
            raise DemoError(f"rosrv protect on the robot failed: {said.strip()}")

    def start_operator(self) -> Actor:
        return self._start(self.operator_host, "ocu", [NODE_PYTHON, str(self.nodes / "ocu.py")])

    def command(self, what: str, *values: str) -> Event:
        """Run `command.py` as the operator, whose control unit must have ended, and return its event."""
        program = [NODE_PYTHON, str(self.nodes / "command.py"), what, *values]
        actor = self._start(self.operator_host, "ocu command", program)
        said = actor.expect(
            {"drive": "drove", "reach": "reached", "aim": "aimed", "fire": "fired"}[what], COMMAND_SECONDS
        )
        actor.stop()
        self.actors.remove(actor)
        return said

    def draw(self, ways: dict[str, Sequence[Sequence[float]]], picture: Path) -> None:
        file = self.directory / "ways.json"
        file.write_text(json.dumps(ways))
        command = [sys.executable, "-m", "examples.landshark.ways", str(file), str(picture.resolve())]
        done = subprocess.run(
            command,
            cwd=self.shipped,
            capture_output=True,
            text=True,
            timeout=START_SECONDS,
            check=False,
        )
        if done.returncode:
            raise DemoError(f"the picture {picture} cannot be drawn: {done.stderr.strip()}")

    def console(self) -> Doorway:
        """Forward a port to the console, which listens on the loopback of the appliance's host."""
        return Doorway(self.appliance_host, CONSOLE)

    def rosrv(self, *arguments: str) -> str:
        command = [sys.executable, "-m", "appliance.cli.main", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=START_SECONDS, check=False)
        if done.returncode:
            raise DemoError(f"rosrv {' '.join(arguments)}: {(done.stderr or done.stdout).strip()}")
        return done.stdout

    def order(self, *arguments: str) -> str:
        return self.rosrv(*arguments, "--state", str(self.state))

    def start_runaway(self, heading: float) -> Actor:
        for base in [actor for actor in self.actors if actor.name == "landshark_base"]:
            base.stop()
            self.actors.remove(base)
        command = [NODE_PYTHON, str(self.nodes / "base.py"), "runaway", str(heading)]
        return self._start(self.robot_host, "landshark_base", command)

    def cut_while_driving(self, forward: float) -> Callable[[], None]:
        command = [NODE_PYTHON, str(self.nodes / "command.py"), "dash", str(forward)]
        actor = self._start(self.operator_host, "ocu command", command)
        actor.expect("dashing", COMMAND_SECONDS)
        self._lab.unplug(self.operator_host)

        def plug() -> None:
            actor.process.kill()  # before its old commands can arrive
            actor.stop()
            self.actors.remove(actor)
            self._lab.plug(self.operator_host)

        return plug

    def attack(self, name: str) -> Attack:
        attacker = self._start(
            self.attacker_host, "attacker", [NODE_PYTHON, str(self.nodes / "attacker.py"), name]
        )
        said = attacker.expect("attacked", ATTACK_SECONDS)
        attacker.stop()
        self.actors.remove(attacker)
        answer = said["answer"]
        text = str(answer[1]) if len(answer) > 1 and isinstance(answer[0], int) else json.dumps(answer)
        return Attack(name, said["tried"], text, said["succeeded"])

    def audit(self, *flags: str) -> list[dict[str, Any]]:
        """Return the records that `rosrv audit search` finds with these flags."""
        command = [sys.executable, "-m", "appliance.cli.main", "audit", "search", *flags, "--json"]
        command += ["--state", str(self.state)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=START_SECONDS, check=False)
        if done.returncode:
            raise DemoError(f"the audit log cannot be read: {done.stderr.strip()}")
        return [json.loads(line) for line in done.stdout.splitlines() if line.strip()]

    def recorded(self, find: Callable[[list[Record]], Record | None], *flags: str) -> Record | None:
        """Repeat a search until `find` returns a record: the log writes it shortly after the answer to the call.

        Return None after `RECORD_SECONDS`.
        """
        end = time.monotonic() + RECORD_SECONDS
        while (found := find(self.audit(*flags))) is None and time.monotonic() < end:
            pass  # a search is a process, which takes a moment
        return found

    def close(self) -> None:
        for actor in self.actors[1:]:
            actor.interrupt()  # all at once, because each takes a second to end
        for actor in reversed(self.actors):
            actor.stop()
        self.actors.clear()
        shutil.rmtree(self.directory, ignore_errors=True)

    def _start(self, host: Host, name: str, command: list[str]) -> Actor:
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("ROS_", "ROSRV_"))}
        environment = kept | {
            "ROS_MASTER_URI": self.master,
            "ROS_IP": host.address,
            "ROS_HOME": str(self.directory / host.name),
            "PYTHONUNBUFFERED": "1",
        }
        actor = Actor(host, name, command, environment, self.directory / f"{name.replace(' ', '-')}.log")
        self.actors.append(actor)
        return actor

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
