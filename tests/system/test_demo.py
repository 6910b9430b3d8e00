"""`rosrv demo`, the first thing a newcomer runs: it works, tells the truth, and leaves nothing behind."""

import os
import signal
import subprocess
from pathlib import Path

import pytest

from appliance.network.namespaces import namespaces
from tests.support.appliance import ROSRV
from tests.support.nodes import has_ros
from tests.support.processes import Process, ThisMachine
from tests.support.requirements import need_root, needs

LIMIT = 180


@pytest.fixture(autouse=True)
def machine() -> None:
    """The demonstration needs root and ROS."""
    need_root()
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")


def left_behind() -> list[str]:
    """The namespaces and folders of a demonstration that are still there."""
    folders = [str(path) for path in Path("/tmp").glob("rosrv-demo-*")]
    return [namespace.name for namespace in namespaces("rosrv-demo.")] + folders


def test_demo() -> None:
    """The robot obeys its operator, every attack is refused by a rule, and the exit status says so."""
    done = subprocess.run([ROSRV, "demo"], capture_output=True, text=True, timeout=LIMIT, check=False)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert "NOT OK" not in said
    assert "fired one shot" in said
    for line in (
        "refused   take over the operator",
        "refused   forge the trigger",
        "refused   kill a node",
        "refused   try every port",
        "refused   go past the master",
        "[Commands] default (landshark-demo.ini:",
        "allowed   watch the battery",
        "without a monitor the robot hits itself: 1 shot",
        "with the monitor it does not: 0 shots",
    ):
        assert line in said
    assert left_behind() == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "SIGTERM"])
def test_demo_interrupted(number: signal.Signals) -> None:
    """Interrupted in the middle, it ends at once and leaves no host, no process and no folder."""
    with Process(ThisMachine(), [ROSRV, "demo"], env=os.environ, label="rosrv demo") as demo:
        demo.wait_for_text("drove", timeout=LIMIT)
        assert demo.stop(with_signal=number, timeout=30) == 130, demo.story()
    assert left_behind() == []


def test_demo_without_root() -> None:
    """Who is not root is told so, in words, before anything is started."""
    command = ["/usr/bin/setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", ROSRV, "demo"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
    assert done.returncode == 1
    assert "needs root" in done.stderr
    assert "Traceback" not in done.stderr
