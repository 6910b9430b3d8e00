"""Debian's unmodified rospy and roscpp nodes, and the stock tools, started against a master.

    ros.talker("rospy", "/chatter")
    ros.listener("roscpp", "/chatter").wait_for(event="received")

The programs in `rospy_nodes/` and `roscpp_nodes/` print the same events.
"""

import contextlib
import fcntl
import functools
import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, Self

from tests.support import forks
from tests.support.processes import LIMIT, Event, Host, Process, ThisMachine
from tests.support.requirements import needs

Client = Literal["rospy", "roscpp"]
PYTHON = forks.PYTHON
HERE = Path(__file__).parent
ROOT = HERE.parents[1]
BUILD = ROOT / "build" / "tests"


# rospy ends in its signal handler. A signal in the middle of `publish`, of a line of its log, or of its own end, waits
# for a lock that a lower frame of the thread holds, or for a thread that waits for that lock.
_IN_ITS_OWN_WAY = re.compile(
    r"Current thread.*in signal_shutdown.*in _ros_signal.*(in (publish|_ros_atexit)|/logging/__init__\.py)",
    re.DOTALL,
)


@contextlib.contextmanager
def answering(*arguments: str) -> Iterator[Callable[[Any], Any]]:
    """Run a program of ROS's Python that answers each line of JSON with one."""
    command = [PYTHON, *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        to_program, from_program = process.stdin, process.stdout

        def ask(question: Any) -> Any:
            to_program.write(json.dumps(question) + "\n")
            to_program.flush()
            return json.loads(from_program.readline())

        yield ask
        to_program.close()


class RosSession:
    def __init__(self, master_uri: str, home: Path, host: Host | None = None) -> None:
        self.master_uri, self.home = master_uri, home
        self.host: Host = host or ThisMachine()
        self.processes: list[Process] = []

    def on(self, host: Host) -> "RosSession":
        other = RosSession(self.master_uri, self.home, host)
        other.processes = self.processes
        return other

    def environment(self, host: Host) -> dict[str, str]:
        kept = {
            key: value
            for key, value in os.environ.items()
            if not key.startswith(("ROS_", "ROSRV_", "PYTHON"))
        }
        return kept | {
            "ROS_MASTER_URI": self.master_uri,
            "ROS_IP": host.address,
            "ROS_HOME": str(self.home),
            "ROS_LOG_DIR": str(self.home / "log"),
            "PYTHONUNBUFFERED": "1",
            "PYTHONFAULTHANDLER": "1",  # on a stuck process, print its stack
            "PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
        }

    def start(self, command: Sequence[str], *, label: str | None = None, **environment: str) -> Process:
        process = Process(
            forks.Forking(self.host),
            command,
            env=self.environment(self.host) | environment,
            label=label or Path(command[0]).name,
            cwd=str(self.home),
        )
        self.processes.append(process)
        return process

    def node(self, client: Client, program: str, *arguments: str, name: str | None = None) -> Process:
        name = name or f"{program}_{len(self.processes)}"
        if client == "rospy":
            command = [PYTHON, str(HERE / "rospy_nodes" / f"{program}.py")]
        else:
            command = [str(roscpp_program(program))]
        process = self.start([*command, *arguments, f"__name:={name}"], label=f"{client} {program}")
        process.wait_for(event="ready")
        return process

    def talker(self, client: Client, topic: str, *options: str, name: str | None = None) -> Process:
        """Publish std_msgs/String `hello N` (or `--text`) ten times a second; with `--latch`, once and latched."""
        return self.node(client, "talker", topic, *options, name=name)

    def listener(self, client: Client, topic: str, *options: str, name: str | None = None) -> Process:
        """Subscribe to a std_msgs/String. The event `received` has `data` and `publisher`."""
        return self.node(client, "listener", topic, *options, name=name)

    def service_server(self, client: Client, service: str, name: str | None = None) -> Process:
        """Offer a std_srvs/SetBool that answers with the negation. The event is `called`."""
        return self.node(client, "service_server", service, name=name)

    def service_client(self, client: Client, service: str, *options: str, name: str | None = None) -> Process:
        """Call a std_srvs/SetBool for each input line `true` or `false`. The events are `answered` and `failed`."""
        return self.node(client, "service_client", service, *options, name=name)

    def parameters(self, client: Client, *options: str, name: str | None = None) -> Process:
        return self.node(client, "parameters", *options, name=name)

    def run(
        self, *command: str, timeout: float = LIMIT, check: bool = True, text: str | None = None
    ) -> subprocess.CompletedProcess[str]:
        with (
            tempfile.TemporaryFile("w+") as given,
            tempfile.TemporaryFile("w+") as out,
            tempfile.TemporaryFile("w+") as err,
        ):
            given.write(text or "")
            given.seek(0)
            popen = forks.Forking(self.host).popen(
                command,
                env=self.environment(self.host),
                cwd=str(self.home),
                stdin=given,
                stdout=out,
                stderr=err,
                start_new_session=True,
            )
            try:
                status, late = popen.wait(timeout), False
            except subprocess.TimeoutExpired:
                popen.kill()
                status, late = popen.wait(), True
            for file in (out, err):
                file.seek(0)
            done = subprocess.CompletedProcess(command, status, out.read(), err.read())
        if late or (check and status):
            how = f"no end in {timeout:.0f} s" if late else f"exit status {status}"
            raise AssertionError(f"{' '.join(command)}: {how}\n{done.stdout}\n{done.stderr}")
        return done

    def story(self) -> str:
        return "\n".join(process.story() for process in self.processes)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        for process in reversed(self.processes):
            process.interrupt()
        for process in self.processes:
            process.stop()
        deaf = [
            process.story()
            for process in self.processes
            if process.deaf and not _IN_ITS_OWN_WAY.search(process.story())
        ]
        assert not deaf, "did not end on SIGINT:\n" + "\n".join(deaf)


def numbers(events: Iterable[Event]) -> list[int]:
    return [int(event["data"].split()[-1]) for event in events]


def without_gap(numbers: Sequence[int]) -> bool:
    return list(numbers) == list(range(numbers[0], numbers[0] + len(numbers)))


_PACKAGE = """\
<package format="2">
  <name>rosrv_nodelets</name><version>1.0.0</version><description>A nodelet of the tests.</description>
  <maintainer email="nobody@example.com">ROSRV</maintainer><license>Apache-2.0</license>
  <depend>nodelet</depend>
  <export><nodelet plugin="${prefix}/nodelets.xml"/></export>
</package>
"""
_NODELETS = """\
<library path="echo_nodelet">
  <class name="rosrv_nodelets/Echo" type="rosrv_nodelets::Echo" base_class_type="nodelet::Nodelet"/>
</library>
"""
_FLAGS = {
    "bonded": ["-lbondcpp"],
    "goals": ["-lactionlib", "-lboost_thread"],
    "echo_nodelet": [
        *("-shared", "-fPIC", "-lnodeletlib", "-lclass_loader"),
        *(f"-I/usr/include/{name}" for name in ("pluginlib", "class_loader", "rcpputils", "rcutils")),
    ],
}


@functools.cache
def roscpp_program(name: str) -> Path:
    source, header = HERE / "roscpp_nodes" / f"{name}.cpp", HERE / "roscpp_nodes" / "report.hpp"
    target = BUILD / name
    BUILD.mkdir(parents=True, exist_ok=True)
    with (BUILD / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # one at a time; a second process waits and finds it
        if target.exists() and header.stat().st_mtime > target.stat().st_mtime:
            target.unlink()
        subprocess.run(
            [str(ROOT / "scripts" / "build-roscpp"), str(source), str(target), *_FLAGS.get(name, [])],
            check=True,
        )
    return target


def nodelet_library(prefix: Path) -> dict[str, str]:
    """Lay out a package with the nodelet `rosrv_nodelets/Echo`; return the environment in which a manager finds it."""
    package, library = "rosrv_nodelets", prefix / "lib" / "libecho_nodelet.so"
    index, share = prefix / "share/ament_index/resource_index", prefix / "share" / package
    for folder in (library.parent, index / "packages", index / "nodelet__pluginlib__plugin", share):
        folder.mkdir(parents=True)
    shutil.copy(roscpp_program("echo_nodelet"), library)
    (index / "packages" / package).touch()
    (index / "nodelet__pluginlib__plugin" / package).write_text(f"share/{package}/nodelets.xml\n")
    (share / "package.xml").write_text(_PACKAGE)
    (share / "nodelets.xml").write_text(_NODELETS)
    return {"AMENT_PREFIX_PATH": str(prefix), "ROS_PACKAGE_PATH": f"{share}:/usr/share"}


def need_ros() -> None:
    tools = ("rosmaster", "rostopic", "roslaunch", "g++")
    needs(all(shutil.which(tool, path="/usr/bin") for tool in tools), "ROS 1 and g++ (run `make setup`)")
