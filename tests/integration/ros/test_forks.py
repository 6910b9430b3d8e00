import json
import signal
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from examples.landshark.lab import Lab
from tests.support.forks import PYTHON, Fork, Forking
from tests.support.nodes import RosSession, need_ros
from tests.support.processes import LIMIT, Host, ThisMachine

LOOK = """
import faulthandler, gc, json, os, resource, signal, sys, threading
import rosgraph.names, rospy
print(json.dumps({
    "arguments": sys.argv,
    "environment": dict(os.environ),
    "folder": os.getcwd(),
    "modules from": sys.path,
    "own session": os.getsid(0) == os.getpid(),
    "network": os.readlink("/proc/self/ns/net"),
    "descriptors": sorted(os.listdir("/proc/self/fd")),
    "signals": [str(signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGPIPE)],
    "limits": resource.getrlimit(resource.RLIMIT_NOFILE),
    "threads": threading.active_count(),
    "buffered": [sys.stdout.write_through, sys.stdout.line_buffering, faulthandler.is_enabled()],
    "names": [rospy.get_name(), rospy.get_namespace(), rospy.names.get_mappings(), rospy.resolve_name("here")],
    "said": sys.stdin.read(),
    "main": [__name__, [one for one in sorted(globals()) if one in ("serve", "order", "main")]],
}))
sys.exit(3)
"""


def looked(host: Host | Forking, command: list[str], environment: Mapping[str, str], folder: Path) -> Any:
    started = host.popen(
        command, env=environment, cwd=str(folder), start_new_session=True, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    with started:
        assert started.stdin is not None
        assert started.stdout is not None
        started.stdin.write("a word")
        started.stdin.close()
        return json.loads(started.stdout.read()), started.wait(LIMIT)


@pytest.mark.parametrize("place", ["this machine", "a host"])
@pytest.mark.parametrize("form", ["-c", "file"])
def test_a_fork_looks_like_a_new_process(lab: Lab, tmp_path: Path, place: str, form: str) -> None:
    need_ros()
    host = ThisMachine() if place == "this machine" else lab.host("robot", "10.77.0.10/24")
    file = tmp_path / "look.py"
    file.write_text(LOOK)
    command = [PYTHON, "-c", LOOK] if form == "-c" else [PYTHON, str(file)]
    command += ["--flag", "here:=/there", "__ns:=/left"]
    environment = RosSession("http://10.0.0.1:11311", tmp_path, host).environment(host)
    seen = [looked(one, command, environment, tmp_path) for one in (host, Forking(host))]
    assert seen[0] == seen[1]
    assert seen[0][1] == 3


def test_a_fork_ends_as_a_process_does(tmp_path: Path) -> None:
    need_ros()
    host, program = ThisMachine(), "import signal; print('here'); signal.pause()"
    environment = RosSession("", tmp_path, host).environment(host)
    for number in (signal.SIGTERM, signal.SIGKILL):
        fork = Forking(host).popen(
            [PYTHON, "-c", program], env=environment, cwd=str(tmp_path), text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        with fork:
            assert isinstance(fork, Fork)
            assert fork.stdout is not None
            assert fork.stdout.readline() == "here\n"
            assert fork.poll() is None
            with pytest.raises(subprocess.TimeoutExpired):
                fork.wait(0)
            fork.send_signal(number)
            assert fork.wait(LIMIT) == fork.poll() == -number
            fork.send_signal(number)  # the signal goes to no process
